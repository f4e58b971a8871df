"""What can be said against a reconstruction: its rank, its flags, points behind cameras.

An adjustment always ends somewhere. Whether the observations determine it is counted and measured
in the normal matrix: of N, all but the gauge must be of full rank. Where noise hides a degenerate
scene from N, two views at a time tell: a flat scene or a camera that turns leaves homographies.
One file a cause; `projective` and `metric` ask them all.
"""
