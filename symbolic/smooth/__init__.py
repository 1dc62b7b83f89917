"""The polish's smooth problem as expressions: samples, places, passages, and driven points."""
