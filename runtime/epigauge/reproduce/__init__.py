"""Experiments of the papers, repeated: tables, figures, and each claim checked."""
