"""LLVM IR of the kernel sources, made by Numba: one module per target, in which each function of `shared.exports` is

    i32 NAME(i64* words)

All arguments are in one block of int64 words. A number or a truth value takes one word. An array takes two: its address
and its length. A world is the address of the table of its arrays (`shared.kernels`). The module exports nothing else,
and needs nothing from outside.
"""

from __future__ import annotations

import gc
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm

from shared import exports, kernels

FAILED = -(1 << 31)
"""Result of a function that ends with an error of Numba's. There is none as long as the sources raise nothing."""
SPEED_LEVEL = 3
FLOATS_USED = "_fltused"
"""Symbol that code with floats needs on Windows; otherwise it comes with the C library."""


@dataclass(frozen=True)
class Machine:
    """The machine that LLVM makes code for; the fields are those of `llvm::TargetMachine`."""

    triple: str
    cpu: str
    features: str = ""
    reloc: str = "pic"

    def target_machine(self) -> Any:
        """Returns a new target machine of LLVM."""
        target = llvm.Target.from_triple(self.triple)
        return target.create_target_machine(
            cpu=self.cpu, features=self.features, opt=SPEED_LEVEL, reloc=self.reloc, codemodel="small"
        )


@dataclass(frozen=True)
class Source:
    """Numba's result for an exported function: the text of an LLVM module, and the function's name in it."""

    name: str
    symbol: str
    text: str


def numba_sources(root: Path) -> list[Source]:
    """Compiles every exported function of the sources in `root`/shared, without optimisation.

    Call it only once in a process, with NUMBA_OPT=0 and NUMBA_CPU_NAME=generic in the environment.
    """
    import numba
    from numba import types

    from shared import jit, layout

    _without_machine_code()
    _flags_compare_fast()
    options: dict[str, Any] = {name: value for name, value in jit.OPTIONS.items() if name != "cache"}
    jit.OPTIONS.clear()
    jit.OPTIONS.update(options)
    of_word, of_array = _intrinsics()
    scope: dict[str, Any] = {"Arrays": layout.Arrays, "int32": numba.int32, "table_at": of_word}
    scope |= {f"array_{kind}": of_array(getattr(types, name)) for kind, (name, _) in exports.ARRAYS.items()}
    made: list[Source] = []
    gc.disable()  # Numba makes objects by the million, and a tenth of the time would go into looking at them
    for module, functions in exports.EXPORTS.items():
        compiled = jit.second_instance(root / "shared" / f"{module}.py", module + jit.COMPILED)
        for name, kinds in functions.items():
            local = {**scope, "function": getattr(compiled, name)}
            exec(_wrapper(name, kinds, local["function"].py_func.__annotations__["return"] is not None), local)
            jitted: Any = numba.njit((_words_type(),), **options)(local[name])
            result = jitted.overloads[jitted.signatures[0]]
            made.append(Source(name, result.fndesc.llvm_func_name, result.library.get_llvm_str()))
    gc.enable()
    return made


def _without_machine_code() -> None:
    """Lets Numba end with the IR, in this process: it makes no machine code, and no functions for Python and C to call.

    Options of Numba could leave out the functions, too, but they would change the symbols, and so the object files.
    """
    from numba.core import codegen, cpu, lowering

    def nothing(*_: Any) -> None:
        pass

    def own_function(_context: Any, library: Any, *_: Any) -> Any:
        """Links a compiled function. Returns a new built-in function, by which Numba knows it. Nothing calls that."""
        library._ensure_finalized()
        return [].append

    codegen.JITCodeLibrary._finalize_specific = nothing  # type: ignore[method-assign]
    cpu.CPUContext.get_executable = own_function  # type: ignore[method-assign]
    lowering.Lower.create_cpython_wrapper = nothing  # type: ignore[method-assign]
    lowering.Lower.create_cfunc_wrapper = nothing  # type: ignore[method-assign]


def _flags_compare_fast() -> None:
    """Lets Numba compare its flags by what was set, in this process. It reads 40 properties of both otherwise, for each
    call of a function that it meets."""
    from numba.core.targetconfig import TargetConfig

    plain: Any = TargetConfig.__eq__

    def equal(one: Any, other: Any) -> Any:
        return one is other or (type(one) is type(other) and one._values == other._values) or plain(one, other)

    TargetConfig.__eq__ = equal  # type: ignore[method-assign]
    TargetConfig.__hash__ = lambda flags: hash(type(flags))  # type: ignore[method-assign]


def _wrapper(name: str, kinds: str, returns: bool) -> str:
    """Returns the Python source of a function that takes its arguments from a block of words and returns an int32."""

    arguments: list[str] = []
    word = 0
    for kind in kinds:
        if kind == exports.WORLD:
            fields = (f"array_{of}(table, {2 * i})" for i, of in enumerate(exports.FIELDS.values()))
            arguments.append(f"Arrays({', '.join(fields)})")
        elif kind == exports.NUMBER:
            arguments.append(f"words[{word}]")
        elif kind == exports.TRUTH:
            arguments.append(f"words[{word}] != 0")
        else:
            arguments.append(f"array_{kind.lower()}(words, {word})")
        word += exports.words_of(kind)
    table = ["    table = table_at(words, 0)"] if exports.WORLD in kinds else []
    assert kinds.find(exports.WORLD) <= 0, "a world is the first argument, if there is one"
    call = f"function({', '.join(arguments)})"
    result = [f"    return int32({call})"] if returns else [f"    {call}", "    return int32(0)"]
    return "\n".join((f"def {name}(words):", *table, *result))


def _intrinsics() -> tuple[Any, Any]:
    """Returns two intrinsics for compiled functions: the pointer in a word, and the array of a type in two words."""
    from numba import types
    from numba.extending import intrinsic
    from numba.np import arrayobj

    pointer = _words_type()
    populate_array: Any = arrayobj.populate_array

    def word_at(builder: Any, words: Any, at: Any, more: int = 0) -> Any:
        return builder.load(builder.gep(words, [builder.add(at, at.type(more))]))

    @intrinsic
    def of_word(context: Any, words: Any, at: Any) -> Any:
        def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.inttoptr(word_at(builder, *arguments), arguments[0].type)

        return pointer(pointer, types.intp), code

    def of_array(element: Any) -> Any:
        array = types.Array(element, 1, "C")
        size = element.bitwidth // 8

        @intrinsic
        def array_at(context: Any, words: Any, at: Any) -> Any:
            def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
                words, at = arguments
                made = context.make_array(array)(context, builder)
                stride = context.get_constant(types.intp, size)
                populate_array(
                    made,
                    data=builder.inttoptr(word_at(builder, words, at), made.data.type),
                    shape=[word_at(builder, words, at, 1)],
                    strides=[stride],
                    itemsize=stride,
                    meminfo=None,
                )
                return made._getvalue()

            return array(pointer, types.intp), code

        return array_at

    return of_word, of_array


def _words_type() -> Any:
    """Returns the type of a pointer to int64 words."""
    from numba import types

    pointer: Any = types.CPointer
    return pointer(types.int64)


EXPORT = """
define i32 @{name}(ptr %words) {{
  %result = alloca i32
  %trouble = alloca ptr
  store i32 0, ptr %result
  %status = call i32 @{symbol}(ptr %result, ptr %trouble, ptr %words)
  %value = load i32, ptr %result
  %fine = icmp eq i32 %status, 0
  %told = select i1 %fine, i32 %value, i32 {failed}
  ret i32 %told
}}
declare i32 @{symbol}(ptr, ptr, ptr)
"""
BUILT_FROM = """
define i32 @built_from(ptr %words) {{
  %asked = load i64, ptr %words
  %constants = icmp eq i64 %asked, {which}
  %crc = select i1 %constants, i32 {constants}, i32 {code}
  ret i32 %crc
}}
"""


def linked(
    sources: list[Source], code_crc: int, machine: Machine, more: str = "", visible: tuple[str, ...] = ()
) -> tuple[Any, Any]:
    """Returns one optimised module for a machine, and the target machine.

    Args:
        sources: the compiled functions.
        code_crc: the checksum of the sources (`shared.freshness`).
        machine: the machine to make code for.
        more: IR to link with it, such as the binding to Python.
        visible: names of the functions to export; empty: all of them.
    """
    target_machine = machine.target_machine()
    ours = "".join(EXPORT.format(name=each.name, symbol=each.symbol, failed=FAILED) for each in sources)
    ours += BUILT_FROM.format(which=kernels.CONSTANTS_CRC, constants=kernels.constants_crc(), code=code_crc)
    if "windows" in machine.triple:
        ours += f"@{FLOATS_USED} = constant i32 1\n"
    whole = _parsed(ours, machine, target_machine)
    for text in (*(each.text for each in sources), more):
        whole.link_in(_parsed(text, machine, target_machine))
    keep = (*(visible or ("built_from", *(each.name for each in sources))), FLOATS_USED)
    for value in (*whole.functions, *whole.global_variables):
        if not value.is_declaration and value.name not in keep:
            value.linkage = "internal"
    for function in whole.functions:
        if not function.is_declaration and any(name in function.name for name in exports.SMALL):
            function.add_function_attribute("optsize")
    whole.verify()
    builder = llvm.create_pass_builder(target_machine, llvm.create_pipeline_tuning_options(speed_level=SPEED_LEVEL))
    builder.getModulePassManager().run(whole, builder)
    return whole, target_machine


def _parsed(text: str, machine: Machine, target_machine: Any) -> Any:
    text = re.sub(r"^(target (triple|datalayout)|source_filename) .*$", "", text, flags=re.MULTILINE)
    module = llvm.parse_assembly(text)
    module.name = "kernel"
    module.triple = machine.triple
    module.data_layout = str(target_machine.target_data)
    return module
