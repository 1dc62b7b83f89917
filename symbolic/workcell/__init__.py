"""What a cell is: records, reading and checking its file, the bundle of all its files."""
