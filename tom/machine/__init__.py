"""The machine that a training runs on: devices, memory, processes, addresses."""
