"""Random damage to every kind of file, and the promises that no damage may break."""
