"""The engine of bundle adjustment, for cameras of any model.

From the outside in: `problem` is what `epigauge.lm` minimises; a `linearizer` evaluates it, in
NumPy or in C, observation by observation; `ties` say what a view's own parameters are made of,
`priors` what is known beside the images; `solve` has the normal equations of the unknowns and the
one way to a damped step; `dampings` choose what is added to them; `freedom` and the strategies say
what is fixed and in which gauge the estimate is kept.
"""
