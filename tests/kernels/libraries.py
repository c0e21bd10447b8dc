"""Reads a library's machine, imports and exports: ELF, PE, Mach-O and WebAssembly."""

import struct
from typing import NamedTuple


class Library(NamedTuple):
    """The machine's number in the format of the library, and the names that it imports and exports."""

    machine: int
    imports: set[str]
    exports: set[str]


def _text(data: bytes, at: int) -> str:
    return data[at : data.index(b"\0", at)].decode()


def elf(data: bytes) -> Library:
    """Reads a shared object of a 64-bit, little-endian ELF machine (62: x86-64, 183: AArch64)."""
    assert data[:6] == b"\x7fELF\2\1"
    (machine,) = struct.unpack_from("<H", data, 18)
    (sections_at,) = struct.unpack_from("<Q", data, 40)
    size, count, _ = struct.unpack_from("<3H", data, 58)
    sections = [struct.unpack_from("<2I4Q2I2Q", data, sections_at + size * i) for i in range(count)]
    imports, exports = set[str](), set[str]()
    for section in sections:
        if section[1] != 11:  # SHT_DYNSYM
            continue
        names = sections[section[6]][4]
        for at in range(section[4], section[4] + section[5], 24):
            name, _, _, where = struct.unpack_from("<IBBH", data, at)
            if name:
                (exports if where else imports).add(_text(data, names + name))
    return Library(machine, imports, exports)


def pe(data: bytes) -> Library:
    """Reads a DLL for 64-bit Windows (0x8664: x86-64). Imports have the name of their library."""
    (at,) = struct.unpack_from("<I", data, 60)
    assert data[at : at + 4] == b"PE\0\0"
    machine, count = struct.unpack_from("<HH", data, at + 4)
    (optional,) = struct.unpack_from("<H", data, at + 20)
    header = at + 24
    assert struct.unpack_from("<H", data, header)[0] == 0x20B
    sections = [struct.unpack_from("<4I", data, header + optional + 40 * i + 8) for i in range(count)]

    def place(rva: int) -> int:
        for _, low, length, raw in sections:
            if low <= rva < low + length:
                return int(raw + rva - low)
        raise AssertionError(f"{rva:x}: not in a section")

    export_rva, _, import_rva, _ = struct.unpack_from("<4I", data, header + 112)
    table = place(export_rva)
    (names,) = struct.unpack_from("<I", data, table + 24)
    (named,) = struct.unpack_from("<I", data, table + 32)
    exports = {_text(data, place(rva)) for rva in struct.unpack_from(f"<{names}I", data, place(named))}
    imports = set[str]()
    entry = place(import_rva)
    while (row := struct.unpack_from("<5I", data, entry))[3]:
        library, thunk = _text(data, place(row[3])), place(row[0])
        while (hint := struct.unpack_from("<Q", data, thunk)[0]) != 0:
            imports.add(f"{library}:{_text(data, place(hint) + 2)}")
            thunk += 8
        entry += 20
    return Library(machine, imports, exports)


def macho(data: bytes) -> Library:
    """Reads a signed library for 64-bit macOS (0x100000C: Apple's arm64)."""
    magic, machine, _, _, count = struct.unpack_from("<5I", data)
    assert magic == 0xFEEDFACF
    at, signed = 32, False
    imports, exports = set[str](), set[str]()
    for _ in range(count):
        command, size = struct.unpack_from("<2I", data, at)
        signed |= command == 0x1D  # LC_CODE_SIGNATURE
        if command == 2:  # LC_SYMTAB
            symbols, length, names, _ = struct.unpack_from("<4I", data, at + 8)
            for i in range(length):
                name, kind = struct.unpack_from("<IB", data, symbols + 16 * i)
                if kind & 1 and not kind & 0xE0:  # N_EXT, and no debugging entry
                    (exports if kind & 0xE else imports).add(_text(data, names + name).removeprefix("_"))
        at += size
    assert signed
    return Library(machine, imports, exports)


def wasm(data: bytes) -> Library:
    """Reads a WebAssembly module. Imports and exports have the form KIND:NAME."""
    assert data[:8] == b"\0asm\1\0\0\0"
    at = 8
    imports, exports = set[str](), set[str]()
    kinds = ("function", "table", "memory", "global")

    def number() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = data[at]
            at += 1
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value

    def name() -> str:
        nonlocal at
        length = number()
        at += length
        return data[at - length : at].decode()

    while at < len(data):
        section = number()
        end = number() + at
        if section == 2:
            for _ in range(number()):
                name()
                field, kind = name(), kinds[number()]
                imports.add(f"{kind}:{field}")
                if kind == "memory":
                    flags = number()
                    number()
                    if flags & 1:
                        number()
                elif kind == "global":
                    at += 2
                else:
                    raise AssertionError(f"an import that nothing should need: {kind} {field}")
        elif section == 7:
            for _ in range(number()):
                field, kind = name(), kinds[number()]
                number()
                exports.add(f"{kind}:{field}")
        at = end
    return Library(0, imports, exports)
