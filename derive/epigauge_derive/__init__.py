"""Symbolic derivation of every formula that epigauge computes, and its translation to code.

`models/` holds the geometry: each file derives one family of formulas with SymPy and registers
them as kernels. `emitters/` holds the languages: each file writes every kernel in one language.
A model knows nothing of languages and an emitter nothing of geometry, so a new camera model, a new
criterion or a new language is one new file. ``python -m epigauge_derive`` runs them all.
"""
