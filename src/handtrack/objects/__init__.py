"""Objects that hands grasp: meshes and distance fields."""
