"""Builds the database of grasps: places a hand, fits it to an object, moves it like people do."""
