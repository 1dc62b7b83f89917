"""The work of the programs, apart from their options; imported when they run."""
