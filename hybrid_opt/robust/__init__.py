"""Forces that hold although friction, mass, centre of mass and pads are not exactly known."""
