"""Symbolic derivation of every formula that epigauge computes, and its translation to code.

`models/` holds the geometry: each file derives one family of formulas with SymPy and registers
them as kernels. `emitters/` holds the languages: each file writes every kernel in one language.
A model knows nothing of languages and an emitter nothing of geometry. ``python -m epigauge_derive``
runs them all.

A new camera model is one new file in `models/cameras/`: its kernels, its gauge (`gauge`) and its
row in the tables that the runtime goes through follow from it (`camera_model`). A new criterion
also takes a class in the runtime, and a new language its rows in the runtime's table of backends.
"""
