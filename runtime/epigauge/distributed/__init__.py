"""Bundle adjustment by many processes, on one machine or many, through Dask.

The processes are those of a client: ``pip install "epigauge[dask]"``.
"""

from epigauge.distributed.adjust import bundle_adjust

__all__ = ["bundle_adjust"]
