"""The cameras: each module has `MODEL`, one camera model; its file is named like its kernels."""
