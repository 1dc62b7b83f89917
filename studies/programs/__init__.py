"""The work of the programs, apart from their options. It is imported when a program runs."""
