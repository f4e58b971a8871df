"""Bundle adjustment by many processes, on one machine or many, through Dask.

The processes are those of a client: ``pip install "epigauge[dask]"``.
"""

from epigauge.distributed.adjust import bundle_adjust
from epigauge.distributed.parts_adjust import PartsResult
from epigauge.distributed.write_parts import Chunk, write_parts

__all__ = ["Chunk", "PartsResult", "bundle_adjust", "write_parts"]
