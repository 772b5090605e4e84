"""One thread for each worker: small networks gain nothing from two, and workers share the cores."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported; children inherit it
