"""From projective to metric: cameras of unknown intrinsics become calibrated ones.

`quadric` finds metric bases, `scene` makes calibrated cameras of them, `samples` chooses the points
to begin with, `motion` names the motions that leave intrinsics open, `upgrade` puts them together;
`pair` has the closed form of two views.
"""
