"""Constraints of the polish: rows near their bounds, required values, violated rows. `distances`
has those of distances, `kinds` all others and the selection among them."""
