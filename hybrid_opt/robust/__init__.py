"""Normal forces that hold the box although friction, mass, centre of mass and pads are known only
within ranges."""
