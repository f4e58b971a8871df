"""From projective to metric: cameras of unknown intrinsics become calibrated ones.

`quadric` finds metric bases, `scene` makes calibrated cameras of them, `samples` chooses the points
to begin with, `growth` finds calibrated cameras in turn where no projective reconstruction serves,
`motion` names the motions that leave intrinsics open, `upgrade` puts them together, `verdict` says
what came out; `pair` has the closed form of two views.
"""
