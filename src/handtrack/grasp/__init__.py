"""Stage: motions that grasp an object, and the control that carries them out under physics."""
