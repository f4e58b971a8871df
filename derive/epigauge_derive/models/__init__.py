"""The geometry. Each module has `kernels()`: the list of kernels of one formula family."""
