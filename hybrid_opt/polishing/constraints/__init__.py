"""What each kind of constraint calls near, requires and finds violated: one file per kind."""
