"""Stands in for libatomic.so.1 where a Linux system has none, so that Dr.Jit can be loaded.

Dr.Jit's library of threads is linked to GCC's libatomic for one function, a compare-and-exchange of
16 bytes, which on x86-64 is one instruction. The wheel of Dr.Jit does not bring the library
(mitsuba-renderer/drjit#484), and minimal systems, such as slim images of containers, lack it. Only
an administrator could install it there.

So if the system has no libatomic.so.1, this module writes a shared library of that name, with that
one function, into memory, and loads it. The dynamic linker takes a library that is loaded already
for any that is needed under its name. The layout of the file follows the System V ABI (ELF-64) and
the Linux Standard Base, which describes versions of symbols.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct
import sys
import tempfile
from pathlib import Path

_NAME = b"libatomic.so.1"
_VERSION = b"LIBATOMIC_1.0"
_FUNCTION = b"__atomic_compare_exchange_16"
_FILE_NAME = "harnack-libatomic"
_PAGE = 4096
_HEADER_LENGTH = 64 + 4 * 56  # the header of the file, and four program headers

# bool f(void *memory, void *expected, unsigned __int128 desired, int success, int failure), by the
# calling convention of System V: rdi, rsi, (rdx, rcx) and two memory orders, which need no code
# since the locked instruction is sequentially consistent, the strongest of them.
_MACHINE_CODE = bytes.fromhex(
    "f30f1efa"  # endbr64
    "53"  # push rbx, which belongs to the caller
    "4889d3"  # mov rbx, rdx: the desired value is rcx:rbx
    "488b06"  # mov rax, [rsi]
    "488b5608"  # mov rdx, [rsi + 8]: the expected value is rdx:rax
    "f0480fc70f"  # lock cmpxchg16b [rdi]
    "7507"  # jne different
    "b801000000"  # mov eax, 1
    "5b"  # pop rbx
    "c3"  # ret
    "488906"  # different: mov [rsi], rax
    "48895608"  # mov [rsi + 8], rdx: the value that was there
    "31c0"  # xor eax, eax
    "5b"  # pop rbx
    "c3"  # ret
)


def provide_atomic_library() -> None:
    """Load a stand-in for libatomic.so.1 if this system needs it and has none.

    Nothing is done on systems other than Linux on x86-64. If the stand-in cannot be loaded, as
    where the system forbids programs to make code, importing Dr.Jit fails: its error names the
    library, and `import_drjit` adds the command that installs it.
    """
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return
    try:
        ctypes.CDLL(_NAME.decode())
    except OSError:
        try:
            _load_from_memory(shared_library())
        except OSError:
            return


def is_stand_in_loaded() -> bool:
    """Return whether this process has loaded the stand-in. On Linux, the memory map of the process
    lists it under the name of its file."""
    maps = Path("/proc/self/maps")
    return maps.exists() and _FILE_NAME in maps.read_text(errors="replace")


def _load_from_memory(content: bytes) -> None:
    """Load a shared library with this content into the process, from a file in memory or, where
    that is not to be had, from a temporary file, which is deleted again.

    The file in memory stays open: the dynamic linker would take another file that got its number,
    and so its path, for this library.

    Raises:
        OSError: the library cannot be loaded.
    """
    try:
        descriptor = os.memfd_create(_FILE_NAME)
    except (AttributeError, OSError):
        with tempfile.NamedTemporaryFile(prefix=_FILE_NAME) as file:
            file.write(content)
            file.flush()
            ctypes.CDLL(file.name)
        return
    os.write(descriptor, content)
    ctypes.CDLL(f"/proc/self/fd/{descriptor}")


def shared_library() -> bytes:
    """Return the content of the stand-in: an ELF file for Linux on x86-64 with the name (SONAME)
    libatomic.so.1, which exports __atomic_compare_exchange_16 in version LIBATOMIC_1.0.

    The file has two segments: tables and code, which may be read and executed, and the dynamic
    section, which the dynamic linker may write to.
    """
    strings = b"\0" + b"\0".join((_NAME, _VERSION, _FUNCTION)) + b"\0"
    name, version, function = (strings.index(text) for text in (_NAME, _VERSION, _FUNCTION))
    tables = {
        "strings": strings,
        # One bucket, which leads to symbol 1 of 2; chains end with 0.
        "hash": struct.pack("<5I", 1, 2, 1, 0, 0),
        # The null symbol is local (0), the function has the version of index 2.
        "symbol versions": struct.pack("<2H", 0, 2),
        # Versions: that of the file itself (flag 1, index 1), and that of the function (index 2).
        "versions": _version(1, 1, _NAME, name, is_last=False)
        + _version(0, 2, _VERSION, version, is_last=True),
        "code": _MACHINE_CODE,
    }
    content = bytearray(_HEADER_LENGTH)
    address: dict[str, int] = {}
    for key, table in tables.items():
        address[key] = _append(content, table)
    # Behind the null symbol comes a global function (0x12) with default visibility (0). Any number
    # of a section serves that does not mean "undefined" (0).
    symbol = struct.pack("<IBBHQQ", function, 0x12, 0, 1, address["code"], len(_MACHINE_CODE))
    address["symbols"] = _append(content, bytes(24) + symbol)
    text_end = len(content)
    dynamic = _dynamic_section(address, name, len(strings))
    dynamic_offset = _append(content, dynamic)
    content[:_HEADER_LENGTH] = _headers(text_end, dynamic_offset, len(dynamic))
    return bytes(content)


def _append(content: bytearray, table: bytes) -> int:
    """Append a table at the next multiple of 16 bytes, and return that offset."""
    content += bytes(-len(content) % 16)
    offset = len(content)
    content += table
    return offset


def _version(flags: int, index: int, text: bytes, offset: int, *, is_last: bool) -> bytes:
    """Return the definition of one version of symbols: its record and its name.

    text: the name. offset: of the name in the table of strings.
    """
    following = 0 if is_last else 28
    record = struct.pack("<HHHHIII", 1, flags, index, 1, _elf_hash(text), 20, following)
    return record + struct.pack("<II", offset, 0)


def _elf_hash(text: bytes) -> int:
    """Return the hash of a name, as the System V ABI defines it."""
    value = 0
    for byte in text:
        value = (value << 4) + byte
        high = value & 0xF0000000
        value = (value ^ (high >> 24)) & ~high
    return value & 0xFFFFFFFF


def _dynamic_section(address: dict[str, int], name: int, string_length: int) -> bytes:
    """Return the dynamic section: pairs of a tag and a value, by which the dynamic linker finds the
    tables. address: of each table. name: offset of the library's name in the table of strings."""
    entries = (
        (14, name),  # DT_SONAME
        (4, address["hash"]),  # DT_HASH
        (5, address["strings"]),  # DT_STRTAB
        (6, address["symbols"]),  # DT_SYMTAB
        (10, string_length),  # DT_STRSZ
        (11, 24),  # DT_SYMENT
        (0x6FFFFFF0, address["symbol versions"]),  # DT_VERSYM
        (0x6FFFFFFC, address["versions"]),  # DT_VERDEF
        (0x6FFFFFFD, 2),  # DT_VERDEFNUM
        (0, 0),  # DT_NULL
    )
    return b"".join(struct.pack("<QQ", *entry) for entry in entries)


def _headers(text_end: int, dynamic_offset: int, dynamic_length: int) -> bytes:
    """Return the header of the file and its four program headers.

    text_end: where the tables and the code end. The dynamic section is loaded one page later than
    it lies in the file, so that no page belongs to both segments.
    """
    dynamic_address = dynamic_offset + _PAGE
    # Magic, 64 bits, little endian, version 1; a shared library (3) for x86-64 (62).
    identity = b"\x7fELF" + bytes((2, 1, 1)) + bytes(9)
    header = identity + struct.pack("<HHIQQQIHHHHHH", 3, 62, 1, 0, 64, 0, 0, 64, 56, 4, 64, 0, 0)

    def segment(kind: int, flags: int, offset: int, start: int, length: int, align: int) -> bytes:
        """Return a program header. flags: 1 execute, 2 write, 4 read."""
        return struct.pack("<IIQQQQQQ", kind, flags, offset, start, start, length, length, align)

    return (
        header
        + segment(1, 4 | 1, 0, 0, text_end, _PAGE)  # PT_LOAD
        + segment(1, 4 | 2, dynamic_offset, dynamic_address, dynamic_length, _PAGE)
        + segment(2, 4 | 2, dynamic_offset, dynamic_address, dynamic_length, 8)  # PT_DYNAMIC
        # Without this segment the linker would make the stack executable, or refuse the library.
        + segment(0x6474E551, 4 | 2, 0, 0, 0, 16)  # PT_GNU_STACK
    )
