"""The functions that are compiled, by who needs them: candidate, cell, timing."""
