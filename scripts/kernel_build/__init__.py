"""The build of the kernels in shared/prebuilt: Numba's IR, a Python module in IR, and the linker."""
