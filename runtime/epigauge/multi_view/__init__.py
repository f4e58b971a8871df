"""Many views: projective bundle adjustment of cameras and points in any gauge."""
