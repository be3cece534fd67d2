"""The only loop, and what people see of it: Rerun, the web page, reports, the command line."""

import os

# One thread per solve: a threaded BLAS makes solves of this size a hundred times slower. It reads these once,
# when NumPy is first imported, so they must stand before any module of this room.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")
