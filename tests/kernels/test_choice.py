"""The choice of a kernel: a prebuilt one that was not built from these sources never runs."""

import ast
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from shared import freshness, kernels
from shared.kernels import AUTO, NUMBA, PLAIN, PREBUILT
from tests.lengths import long

ROOT = Path(__file__).parent.parent.parent
here = pytest.mark.skipif(bool(kernels.trouble()), reason=f"no prebuilt kernel runs here: {kernels.trouble()}")
WHAT = "from shared import kernels; print([kernels.chosen(), kernels.trouble(), kernels.get().form])"


def chosen(root: Path, *flags: str, program: str = WHAT, **environment: str) -> list[str]:
    """Returns the choice of another process in a copy of the sources: the form, the trouble with the prebuilt one, and
    the loaded form."""
    done = subprocess.run(
        (sys.executable, *flags, "-c", program), cwd=root, env=environment, capture_output=True, text=True, check=True
    )
    found: list[str] = ast.literal_eval(done.stdout)
    return found


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A copy of shared/ that a test may change."""
    shutil.copytree(ROOT / "shared", tmp_path / "shared", ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path


def edit(root: Path, file: str, old: str, new: str) -> None:
    path = root / "shared" / file
    text = path.read_text("utf-8")
    assert text.count(old) == 1
    path.write_text(text.replace(old, new), "utf-8")


@pytest.mark.parametrize("form", [PLAIN, pytest.param(PREBUILT, marks=here)])
def test_one_setting_forces_a_form(form: str) -> None:
    assert chosen(ROOT, SOVEREIGN_KERNEL=form)[::2] == [form, form]


def test_an_unknown_form_is_refused_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(kernels.VARIABLE, "fast")
    with pytest.raises(ValueError, match=r"^SOVEREIGN_KERNEL = 'fast': must be one of auto, prebuilt, numba, plain$"):
        kernels.get()


@here
def test_the_prebuilt_one_is_the_first_choice_and_needs_no_numba() -> None:
    program = f"import sys; {WHAT}; assert not {{'numba', 'llvmlite'}} & sys.modules.keys()"
    assert chosen(ROOT, program=program) == [PREBUILT, "", PREBUILT]
    assert kernels.describe(AUTO) == f"prebuilt, {kernels.TARGETS[sys.platform, platform.machine().lower()]}"


STALE = (
    "the prebuilt kernel was not made from the present shared/kernel.py, bulk.py, traffic.py, delivery.py, "
    "pacing.py and places.py; run scripts/kernels"
)
REFUSED = "from shared import kernels; print([kernels.chosen(), kernels.trouble(), kernels.describe()])"


@here
@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("kernel.py", "return least", "return key"),
        ("units.py", "SEGMENT_SHIFT = 5", "SEGMENT_SHIFT = 6"),
        *long(
            ("bulk.py", "ROW_BYTES = 33", "ROW_BYTES = 34"),
            ("layout.py", "STOP_X, STOP_Y, STOP_Z, GO_X", "STOP_Y, STOP_X, STOP_Z, GO_X"),
            ("inputs.py", "MOVE_MAX = 127", "MOVE_MAX = 126"),
            ("exports.py", '"unlink": "wn"', '"unlink": "wnn"'),
        ),
    ],
)
def test_a_change_of_its_code_makes_it_stale(copy: Path, file: str, old: str, new: str) -> None:
    edit(copy, file, old, new)
    instead = NUMBA if kernels.numba_installed() else PLAIN
    assert chosen(copy, program=REFUSED) == [instead, STALE, f"{instead}: {STALE}"]


@here
def test_a_change_of_comments_does_not_make_it_stale(copy: Path) -> None:
    edit(copy, "kernel.py", "    least = heap[0]\n", "\n    # The least is on top.\n    least = heap[0]  # always\n")
    edit(copy, "bulk.py", '"""Returns four bytes from', '"""Returns four bytes\n\n    from')
    assert chosen(copy) == [PREBUILT, "", PREBUILT]
    manifest = copy / "shared" / "prebuilt" / kernels.MANIFEST
    manifest.write_text("{", "utf-8")
    assert chosen(copy) == [PREBUILT, "", PREBUILT]
    manifest.unlink()
    assert chosen(copy) == [PREBUILT, "", PREBUILT]


@here
def test_a_program_without_sources_has_the_ones_it_was_frozen_with(copy: Path) -> None:
    """Only the compiled modules are there, as in a frozen program."""
    subprocess.run((sys.executable, "-m", "compileall", "-q", "-b", "shared"), cwd=copy, check=True)
    for source in (copy / "shared").glob("*.py"):
        source.unlink()
    assert chosen(copy) == [PREBUILT, "", PREBUILT]


@here
@pytest.mark.parametrize("damage", ["cut", *long("missing", "of another platform")])
def test_a_library_that_cannot_be_loaded_is_not_used(copy: Path, damage: str) -> None:
    place = copy / "shared" / "prebuilt"
    library = place / kernels.TARGETS[sys.platform, platform.machine().lower()]
    if damage == "missing":
        library.unlink()
    elif damage == "cut":
        library.write_bytes(library.read_bytes()[:1000])
    else:
        library.write_bytes((place / "kernel.wasm").read_bytes())
    form, why, _ = chosen(copy, program=REFUSED)
    assert form != PREBUILT
    assert why


def test_checksums_of_code_leave_out_what_does_nothing() -> None:
    one = 'def f(a):\n    """What it does."""\n    return a + 1\n'
    same = '"""A module."""\n\n# a comment\ndef f(a):\n\n    return a + 1  # more\n'
    other = "def f(a):\n    return a + 2\n"
    crcs = [freshness.code_crc([text]) for text in (one, same, other)]
    assert crcs[0] == crcs[1] != crcs[2]
    assert freshness.code_crc(["a", "b"]) != freshness.code_crc(["ab"])
    assert freshness.text_crc([one]) != freshness.text_crc([same])


# -- what a library refuses ----------------------------------------------------------------------------------


@here
def test_invalid_arguments_are_refused_and_no_buffer_is_kept() -> None:
    kernel = kernels.get(True)
    if kernel.form != PREBUILT:
        pytest.skip("another form is forced")
    numbers, frozen, small = np.zeros(8, np.int64), np.zeros(8, np.int64), np.zeros(8, np.int32)
    frozen.flags.writeable = False
    nothing = (numbers, numbers, numbers, numbers)
    wrong: list[tuple[str, tuple[object, ...], type[Exception]]] = [
        ("recall", nothing, TypeError),  # too few elements
        ("recall", (*nothing, 0, 0), TypeError),
        ("recall", (*nothing, 0.5), TypeError),
        ("recall", (*nothing, 1 << 63), OverflowError),
        ("recall", (*nothing, None), TypeError),
        ("recall", (numbers, numbers, numbers, 7, 0), TypeError),
        ("recall", (numbers, numbers, numbers, small, 0), TypeError),  # 4 bytes instead of 8
        ("recall", (numbers, numbers, memoryview(frozen.data), numbers, 0), BufferError),
        ("recall", (numbers, numbers.data[::2], numbers, numbers, 0), BufferError),
        ("step", (numbers, numbers, 0, 1), TypeError),  # not the table of a world
        ("read_turns", (b"", numbers, b"12345678"), BufferError),
    ]
    before = [sys.getrefcount(array) for array in (numbers, small, frozen)]
    for name, arguments, error in wrong * 50:
        with pytest.raises(error):
            getattr(kernel, name)(*arguments)
    assert [sys.getrefcount(array) for array in (numbers, small, frozen)] == before
    assert kernel.recall(numbers, numbers, numbers, numbers, 0) == 0
    assert kernel.recall(frozen, numbers, numbers, numbers, False) == 0
