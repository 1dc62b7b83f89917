"""From a CasADi function to compiled C code that NumPy calls, with a content-addressed cache."""
