"""The hand: names, skeleton, shape space, kinematics, the mirror rule."""
