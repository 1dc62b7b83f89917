"""The polish's smooth problem as expressions: samples, arms, and one file per kind of row."""
