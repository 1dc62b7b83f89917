"""The arms: URDF, Pinocchio's model as CasADi functions, kinematics along a path, branches."""
