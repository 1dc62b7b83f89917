"""The polish's nonlinear program: its rows with exact first and second derivatives."""
