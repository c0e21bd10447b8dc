"""A plugin of pytest (`-p tests.kernels.checking`): compiled worlds run a build of the kernel that checks every index.

`scripts/kernels` builds it for this machine from the same IR, with the checks in addition. LLVM loads it into this
process, so no linker is needed. A function that meets an index out of bounds raises a SystemError. Set the environment
of `scripts.kernel_build.build.BUILDING` for the process.
"""

import contextlib
import ctypes
import importlib.machinery
from pathlib import Path
from types import ModuleType
from typing import Any

import llvmlite.binding as llvm
import numpy as np

from scripts.kernel_build import ir, python_module
from shared import exports, kernels

ROOT = Path(__file__).parent.parent.parent

ABI = 3


def loaded() -> tuple[ModuleType, Any]:
    """Returns the Python module of the checked kernel, and the engine that owns its memory."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    names = {**exports.functions(), "built_from": exports.NUMBER}
    machine = ir.Machine(llvm.get_process_triple(), llvm.get_host_cpu_name(), speed=0)  # its checks are the same
    sources = ir.numba_sources(ROOT, bounds=True)
    module, target_machine = ir.linked(sources, 0, machine, python_module.module(names), (python_module.INIT,))
    engine = llvm.create_mcjit_compiler(module, target_machine)
    engine.finalize_object()
    definition = ctypes.PYFUNCTYPE(ctypes.c_void_p)(engine.get_function_address(python_module.INIT))()
    make = ctypes.pythonapi.PyModule_FromDefAndSpec2
    make.restype, make.argtypes = ctypes.py_object, (ctypes.c_void_p, ctypes.py_object, ctypes.c_int)
    made: ModuleType = make(definition, importlib.machinery.ModuleSpec(python_module.MODULE, None), ABI)
    return made, engine


MODULE, ENGINE = loaded()
FORM = kernels.get(True).form
kernels._kernels[FORM] = kernels.kernel_of(MODULE, FORM)

few, many = np.zeros(12, np.int64), np.zeros(24, np.int64)
with contextlib.suppress(SystemError):
    kernels.get(True).alike(few, 2, many, 2, 1, 1, few)  # two states in an array with room for one
    raise AssertionError("indices are not checked")
