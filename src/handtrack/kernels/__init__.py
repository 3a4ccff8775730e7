"""Every Warp kernel, one file per step; arrays in, arrays out."""
