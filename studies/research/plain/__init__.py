"""A plain second implementation of the physics, used as an oracle and as a speed reference."""
