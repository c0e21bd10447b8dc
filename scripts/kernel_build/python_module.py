"""LLVM IR of the module through which CPython calls a kernel. A call costs about 60 ns, against 1 us with ctypes.

The module uses only functions of the stable ABI of CPython 3.11, so one library serves that version and all later ones.
It uses no data of the ABI, because that would need import tables on Windows. Arrays are passed as objects with a
buffer. The buffer protocol rejects a buffer that is not contiguous, and a read-only one where the kernel writes. This
module rejects a wrong element size. Results are whole numbers; functions without a result return 0. The GIL is held,
because no call takes as long as a thread's turn (5 ms).
"""

from __future__ import annotations

from scripts.kernel_build.ir import FAILED
from shared import exports

MODULE = "sovereign_kernel"
INIT = f"PyInit_{MODULE}"
FASTCALL = 0x80
WRITABLE = 1
"""The flag `PyBUF_WRITABLE`; without it a buffer may be read-only."""
BUFFER_BYTES = 80
"""`sizeof(Py_buffer)`: buf, obj, len, itemsize, readonly, ndim, format, shape, strides, suboffsets, internal."""

PYTHON = (
    "PyBuffer_Release", "PyErr_BadArgument", "PyErr_BadInternalCall", "PyErr_Occurred", "PyLong_AsLongLong",
    "PyLong_FromLongLong", "PyModuleDef_Init", "PyObject_GetBuffer",
)  # fmt: skip
"""All functions of Python that the module uses."""

COMMON = """
declare void @PyBuffer_Release(ptr)
declare i32 @PyErr_BadArgument()
declare void @PyErr_BadInternalCall()
declare ptr @PyErr_Occurred()
declare i64 @PyLong_AsLongLong(ptr)
declare ptr @PyLong_FromLongLong(i64)
declare ptr @PyModuleDef_Init(ptr)
declare i32 @PyObject_GetBuffer(ptr, ptr, i32)

; Writes the address and the length of an array to two words. False: an exception is set, and no buffer is held.
define internal i1 @take_array(ptr %object, ptr %buffer, ptr %words, i32 %flags, i64 %size) alwaysinline {
  %got = call i32 @PyObject_GetBuffer(ptr %object, ptr %buffer, i32 %flags)
  %failed = icmp ne i32 %got, 0
  br i1 %failed, label %no, label %check
check:
  %itemsize_at = getelementptr i8, ptr %buffer, i64 24
  %itemsize = load i64, ptr %itemsize_at
  %fits = icmp eq i64 %itemsize, %size
  br i1 %fits, label %yes, label %drop
yes:
  %address = load i64, ptr %buffer
  store i64 %address, ptr %words
  %bytes_at = getelementptr i8, ptr %buffer, i64 16
  %bytes = load i64, ptr %bytes_at
  %length = udiv i64 %bytes, %size
  %length_at = getelementptr i64, ptr %words, i64 1
  store i64 %length, ptr %length_at
  ret i1 true
drop:
  call void @PyBuffer_Release(ptr %buffer)
  call i32 @PyErr_BadArgument()
  br label %no
no:
  ret i1 false
}

; Writes the address of a world's table of arrays to a word. False: an exception is set, and no buffer is held.
define internal i1 @take_world(ptr %object, ptr %buffer, ptr %words) alwaysinline {
  %pair = alloca [2 x i64]
  %got = call i1 @take_array(ptr %object, ptr %buffer, ptr %pair, i32 0, i64 8)
  br i1 %got, label %check, label %no
check:
  %length_at = getelementptr i64, ptr %pair, i64 1
  %length = load i64, ptr %length_at
  %fits = icmp eq i64 %length, TABLE_WORDS
  br i1 %fits, label %yes, label %drop
yes:
  %address = load i64, ptr %pair
  store i64 %address, ptr %words
  ret i1 true
drop:
  call void @PyBuffer_Release(ptr %buffer)
  call i32 @PyErr_BadArgument()
  br label %no
no:
  ret i1 false
}

; Writes a whole number or a truth value to a word. False: an exception is set.
define internal i1 @take_number(ptr %object, ptr %words) alwaysinline {
  %value = call i64 @PyLong_AsLongLong(ptr %object)
  store i64 %value, ptr %words
  %odd = icmp eq i64 %value, -1
  br i1 %odd, label %ask, label %yes
ask:
  %error = call ptr @PyErr_Occurred()
  %none = icmp eq ptr %error, null
  ret i1 %none
yes:
  ret i1 true
}
"""


DEFINITION = """
%definition = type { [5 x i64], ptr, ptr, i64, ptr, ptr, ptr, ptr, ptr }
; PyModuleDef: a base with a reference count of 1; name, doc, size, methods, slots, traverse, clear, free
@definition = internal global %definition {
  [5 x i64] [i64 1, i64 0, i64 0, i64 0, i64 0], ptr @name_module, ptr null, i64 0, ptr @methods, ptr @slots,
  ptr null, ptr null, ptr null
}
"""


def module(names: dict[str, str]) -> str:
    """Returns the IR of a Python module.

    Args:
        names: the functions: their names and the kinds of their arguments (as in `shared.exports`).
    """
    methods = [f"{{ ptr @name_{n}, ptr @python_{n}, i32 {FASTCALL}, ptr null }}" for n in names]
    entries = ", ".join(f"%method {each}" for each in (*methods, "zeroinitializer"))
    return "\n".join(
        (
            COMMON.replace("TABLE_WORDS", str(2 * len(exports.FIELDS))),
            *(_function(name, kinds) for name, kinds in names.items()),
            "%method = type { ptr, ptr, i32, ptr }",
            *(_text(f"name_{name}", name) for name in names),
            _text("name_module", MODULE),
            f"@methods = internal global [{len(names) + 1} x %method] [{entries}]",
            "@slots = internal global [2 x i64] zeroinitializer",
            DEFINITION,
            f"define ptr @{INIT}() {{\n  %made = call ptr @PyModuleDef_Init(ptr @definition)\n  ret ptr %made\n}}",
        )
    )


def _function(name: str, kinds: str) -> str:
    """Returns the IR of `PyObject *NAME(PyObject *self, PyObject *const *arguments, Py_ssize_t n)` for Python."""
    lines = [
        f"define internal ptr @python_{name}(ptr %self, ptr %arguments, i64 %n) {{",
        f"  %words = alloca [{exports.words_of(kinds)} x i64], align 16",
        *(f"  %buffer{i} = alloca [{BUFFER_BYTES} x i8], align 16" for i, kind in enumerate(kinds) if _held(kind)),
        f"  %complete = icmp eq i64 %n, {len(kinds)}",
        "  br i1 %complete, label %take0, label %wrong",
        "wrong:\n  call i32 @PyErr_BadArgument()\n  ret ptr null",
    ]
    word, held = 0, -1
    for i, kind in enumerate(kinds):
        lines += [
            f"take{i}:",
            f"  %at{i} = getelementptr ptr, ptr %arguments, i64 {i}",
            f"  %object{i} = load ptr, ptr %at{i}",
            f"  %words{i} = getelementptr i64, ptr %words, i64 {word}",
            f"  %got{i} = call i1 {_take(i, kind)}",
            f"  br i1 %got{i}, label %take{i + 1}, label %drop{held}",
        ]
        word += exports.words_of(kind)
        held = i if _held(kind) else held
    lines += [
        f"take{len(kinds)}:",
        f"  %result = call i32 @{name}(ptr %words)",
        f"  %failed = icmp eq i32 %result, {FAILED}",
        "  br i1 %failed, label %bad, label %done",
        f"bad:\n  call void @PyErr_BadInternalCall()\n  br label %drop{held}",
        "done:",
        *(f"  call void @PyBuffer_Release(ptr %buffer{i})" for i, kind in enumerate(kinds) if _held(kind)),
        "  %wide = sext i32 %result to i64",
        "  %made = call ptr @PyLong_FromLongLong(i64 %wide)",
        "  ret ptr %made",
    ]
    for i in range(held, -1, -1):
        if _held(kinds[i]):
            before = max((j for j in range(i) if _held(kinds[j])), default=-1)
            lines.append(f"drop{i}:\n  call void @PyBuffer_Release(ptr %buffer{i})\n  br label %drop{before}")
    return "\n".join((*lines, "drop-1:\n  ret ptr null\n}", f"declare i32 @{name}(ptr)")).replace("drop-1", "none")


def _held(kind: str) -> bool:
    """Returns whether an argument of a kind is a buffer, which must be released."""
    return kind not in (exports.NUMBER, exports.TRUTH)


def _take(i: int, kind: str) -> str:
    if not _held(kind):
        return f"@take_number(ptr %object{i}, ptr %words{i})"
    if kind == exports.WORLD:
        return f"@take_world(ptr %object{i}, ptr %buffer{i}, ptr %words{i})"
    flags, (_, size) = WRITABLE if kind.isupper() else 0, exports.item(kind)
    return f"@take_array(ptr %object{i}, ptr %buffer{i}, ptr %words{i}, i32 {flags}, i64 {size})"


def _text(name: str, text: str) -> str:
    return f'@{name} = internal constant [{len(text) + 1} x i8] c"{text}\\00"'
