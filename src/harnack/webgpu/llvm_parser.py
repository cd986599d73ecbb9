"""Parses kernels that Dr.Jit recorded into operations on single lanes, nested loops and branches
(`kernel`). The text of a kernel is a program in LLVM's language.

Dr.Jit writes a kernel for LLVM as a function of packets, vectors of several lanes. The program of
every lane is the same, so the parser replaces packets by single lanes, and drops the masks that
only keep apart the lanes of a packet. It knows the part of LLVM's language that Dr.Jit writes; any
other instruction is refused with a message that shows it.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace

from harnack.webgpu.kernel import (
    Branch,
    BranchResult,
    ComputeKernel,
    Constant,
    Kind,
    Load,
    LocalArray,
    LocalLoad,
    LocalStore,
    Loop,
    LoopVariable,
    Operand,
    Operation,
    Statement,
    Store,
    UntranslatableError,
)

__all__ = ["parse"]

_KINDS: dict[str, Kind] = {"float": "f32", "i32": "u32", "i1": "bool", "i8": "u32"}


def parse(text: str) -> ComputeKernel:
    """Parse a kernel from its text in LLVM's language, as `drjit.kernel_history` returns it.

    Raises:
        UntranslatableError: it contains an unknown operation, or no kernel.
    """
    start = text.rfind("define void @drjit_")
    if start < 0:
        raise UntranslatableError("this text holds no kernel of Dr.Jit for LLVM")
    body = text[start : text.index("\n}", start)]
    width = re.search(r"<(\d+) x ", body)
    reader = _LLVMParser(int(width.group(1)) if width else 1)
    for line in body.split("\n")[1:]:
        reader.parse_line(line)
    return ComputeKernel(reader.statements, reader.labels, tuple(reader.local_arrays.values()))


@dataclass
class _Address:
    """The address from which an instruction reads. It means record `index` of an array of records
    of `stride` numbers each.

    parameter: the index of the array among the kernel's parameters.
    index: the index of the record; None for the array itself.
    mask: whether to read at all; None for always.
    """

    parameter: int
    index: Operand | None = None
    stride: int = 1
    mask: Operand | None = None


@dataclass
class _LocalAddress:
    """The address of entry `index` of the local array with the name `array`."""

    array: str
    index: Operand


_VECTOR = r"<\d+ x (\w+)>"
_NAME = r"%[\w.]+"
# The pattern of an operand: the name of a result, a constant of a packet, or a number.
_OPERAND = r"(%[\w.]+|<[^>]*>|[^,<>]+)"
# Flags of instructions that only say how LLVM may compile them.
_FLAGS = re.compile(r"\b(?:fast|nnan|ninf|nsz|arcp|contract|afn|reassoc|nuw|nsw|exact)\b ?")
_BINARY = [
    "fadd",
    "fsub",
    "fmul",
    "fdiv",
    "sub",
    "mul",
    "udiv",
    "urem",
    "sdiv",
    "srem",
    "and",
    "or",
    "xor",
    "shl",
    "lshr",
    "ashr",
]
_CONVERSIONS = ["bitcast", "sitofp", "uitofp", "fptosi", "fptoui", "sext", "zext"]
_UNARY_CALLS = {
    "sqrt": "sqrt", "fabs": "abs", "floor": "floor", "ceil": "ceil", "trunc": "trunc",
    "nearbyint": "round", "rint": "round", "x86.avx512.rsqrt14": "rsqrt",
    "x86.avx512.rcp14": "rcp", "x86.sse.rsqrt": "rsqrt", "x86.avx.rsqrt": "rsqrt",
    "x86.sse.rcp": "rcp", "x86.avx.rcp": "rcp", "ctpop": "popcount", "abs": "iabs",
}  # fmt: skip
_CALLS = {
    "fma": 3, "fmuladd": 3, "minnum": 2, "maxnum": 2, "minimum": 2, "maximum": 2, "copysign": 2,
    "umin": 2, "umax": 2, "smin": 2, "smax": 2,
}  # fmt: skip


def _ignore(*groups: str) -> None:
    """Do nothing: the action for instructions that have no effect on single lanes."""
    del groups


class _LLVMParser:
    """Parses a kernel, a program in LLVM's language, line by line. Each line assigns the result of
    an instruction to a name. Patterns recognize instructions, and each pattern has an action, a
    method that notes something or appends a statement to the current block: the main program, the
    test or body of a loop, or the body of a branch. An `element` is the LLVM type of a number, such
    as "float". A label is the name of an array, which Dr.Jit prints as a comment above an
    instruction.

    Entry i of a local array is, for a packet, a packet: its lane k is number i * width + k of the
    array. Dr.Jit reads and writes entries in two ways: in a block l_N_u if all active lanes of the
    packet have the same index, which is then the largest of their indices; otherwise in a block
    l_N_n. For a single lane both do the same, so the second is skipped.

    width: the number of lanes of a packet.
    statements: the statements parsed so far.
    labels: for the index of a kernel parameter, the label of its array.
    local_arrays: the local arrays by name.
    """

    def __init__(self, width: int) -> None:
        self.statements: list[Statement] = []
        self.labels: dict[int, str] = {}
        self.local_arrays: dict[str, LocalArray] = {}
        self._width = width
        self._tables: dict[str, int] = {}  # result -> parameter of the table it was read from
        self._current_block = self.statements
        # The loops and branches that contain the current block, each with its number N and the
        # block in which it is, and the condition of the next branch.
        self._open: list[tuple[Loop | Branch, str, list[Statement]]] = []
        self._branch: Branch | None = None  # whose results the next instructions name
        self._branch_condition: Operand = ""
        self._aliases: dict[str, Operand] = {}  # result -> the value that it is another name of
        self._addresses: dict[str, _Address] = {}
        self._local_addresses: dict[str, _LocalAddress] = {}
        self._records: dict[str, _Address] = {}  # result of several numbers -> their address
        self._label: str | None = None
        self._labeled = ""  # the variable that the label belongs to
        self._is_skipped = False  # the instructions of the current block
        self._patterns = {
            word: [(re.compile(pattern), action) for pattern, action in rules]
            for word, rules in self._grammar().items()
        }

    def parse_line(self, line: str) -> None:
        """Parse the next line: a comment (a label), the name of a block, or an instruction. An
        instruction is matched with the patterns for its first word, and the action of the matching
        pattern is called.

        Raises:
            UntranslatableError: the instruction is unknown.
        """
        # Metadata follows ", !".
        text = line.partition(", !")[0].strip()
        if text.startswith(";"):
            self._label, self._labeled = text[1:].strip(), ""
        elif text.endswith(":"):
            self._enter_block(text[:-1])
        elif text and not self._is_skipped:
            result, _, instruction = text.rpartition(" = ")
            variable = result.partition("_")[0]
            # A label belongs to the instructions that compute one variable, such as %f12 and
            # %f12_1.
            self._labeled = self._labeled or variable
            if variable != self._labeled:
                self._label = None
            # Alignments and flags have no effect on the result here.
            instruction = _FLAGS.sub("", instruction.partition(", align ")[0])
            for pattern, action in self._patterns.get(instruction.partition(" ")[0], ()):
                if (match := pattern.fullmatch(instruction)) is not None:
                    # With the name of the result, which a branch and a store lack, and the parts
                    # that the pattern has found.
                    action(*((result,) if result else ()), *match.groups())
                    return
            raise UntranslatableError(
                f"a kernel of this field holds what is not translated for other GPUs: {text[:160]}"
            )

    def _enter_block(self, block: str) -> None:
        """Begin the block of the kernel named `block`.

        A loop has four blocks: the part before it, its test (l_N_cond), its body (l_N_body) and the
        part after it (l_N_done). A conditional statement is two branches: l_N_t runs if a condition
        is True, and l_N_f if another one is; the results of the first are named in l_N_next, and
        those of the second in l_N_end. A local array is accessed in l_N_u or l_N_n, and the results
        are named in l_N_done.
        """
        match = re.fullmatch(r"l_(\d+)_(\w+)", block)
        number, part = match.groups() if match is not None else ("", block)
        self._is_skipped = part == "n"
        self._branch = None
        innermost = self._open[-1][0] if self._open and self._open[-1][1] == number else None
        if part == "cond":
            loop = Loop()
            self._begin(loop, number, loop.test)
        elif part == "body" and isinstance(innermost, Loop):
            self._current_block = innermost.body
        elif part == "done" and isinstance(innermost, Loop):
            # The values after an iteration were kept as text until all of the body was known.
            innermost.variables = [
                replace(variable, after=self._value(str(variable.after), variable.kind))
                for variable in innermost.variables
            ]
            self._end()
        elif part in ("t", "f"):
            branch = Branch(self._branch_condition)
            self._begin(branch, number, branch.body)
        elif part in ("next", "end") and isinstance(innermost, Branch):
            self._end()
            self._branch = innermost

    def _begin(self, statement: Loop | Branch, number: str, block: list[Statement]) -> None:
        """Append a loop or a branch with a number, and make one of its blocks the current one."""
        self._current_block.append(statement)
        self._open.append((statement, number, self._current_block))
        self._current_block = block

    def _end(self) -> None:
        """End the innermost loop or branch."""
        *_, self._current_block = self._open.pop()

    def _value(self, text: str, kind: Kind) -> Operand:
        """Return the operand that a text stands for: the name of a result, or a constant of the
        type `kind`."""
        text = text.strip()
        if text.startswith("%"):
            return self._aliases.get(text, text)
        if text in ("zeroinitializer", "undef", "poison", "false"):
            return Constant(kind, 0)
        if text == "true":
            return Constant(kind, 1)
        # A constant of a packet repeats the constant of a lane: the first one is taken.
        if (match := re.match(r"<\w+ (\S+?)(?:,|>)", text)) is not None:
            text = match.group(1)
        if kind == "f32":
            # LLVM writes floats as decimal numbers or, if these are not exact, as the bits of a
            # double.
            double = (
                struct.unpack(">d", bytes.fromhex(text[2:].zfill(16)))[0]
                if text.startswith("0x")
                else float(text)
            )
            # The bits of the number in single precision.
            return Constant(kind, struct.unpack("<I", struct.pack("<f", double))[0])
        # Negative integers as their 32 bits.
        return Constant(kind, int(text) & 0xFFFFFFFF)

    def _emit(self, result: str, kind: Kind, name: str, *operands: Operand) -> None:
        """Append the operation result = name(operands) to the current block. kind: the type of the
        result."""
        self._current_block.append(Operation(result, kind, name, operands))

    def _label_parameter(self, parameter: int) -> None:
        """If there is a current label, give it to the array of a kernel parameter, unless this
        array has a label already."""
        if self._label is not None:
            self.labels.setdefault(parameter, self._label)

    def _grammar(self) -> dict[str, list[tuple[str, Callable[..., None]]]]:
        """Return the grammar: for the first word of an instruction, a list of (pattern, action).
        The action of the first pattern that matches is called with the name of the result (if the
        instruction has one) and the groups of the pattern."""
        entry = rf"ptr ({_NAME}), <\d+ x i32> (\S+)"
        binary: list[tuple[str, Callable[..., None]]]
        binary = [(rf"(\w+) {_VECTOR} {_OPERAND}, {_OPERAND}", self._arithmetic)]
        convert: list[tuple[str, Callable[..., None]]]
        convert = [(rf"(\w+) {_VECTOR} {_OPERAND} to {_VECTOR}", self._convert)]
        return {
            # Control of packets and branches, and other names of values.
            "br": [
                (rf"br i1 ({_NAME}), label %l_\d+_body, label %l_\d+_done", self._test),
                (rf"br i1 ({_NAME}), label %l_\d+_[tf], label %\w+", self._branch_test),
                (r"br .*", _ignore),
            ],
            "ret": [(r"ret void", _ignore)],
            "phi": [
                (rf"phi {_VECTOR} \[ (\S+), %l_\d+_u \], \[ \S+, %l_\d+_n \]", self._alias),
                (rf"phi {_VECTOR} \[ (\S+), %l_\d+_[tf]_trailer \], \[ undef, %\w+ \]",
                self._branch_result),
                (rf"phi {_VECTOR} \[ (\S+), %\w+ \], \[ (\S+), %\w+ \]", self._phi),
                (r"phi i64 .*", _ignore),
            ],
            "insertelement": [
                (rf"insertelement {_VECTOR} (?:undef|poison), \w+ (\S+), i32 0", self._alias)
            ],
            "shufflevector": [
                (rf"shufflevector {_VECTOR} ({_NAME}), .* zeroinitializer", self._alias)
            ],
            # Arrays.
            "alloca": [(r"alloca (\w+), i32 (\d+)", self._local_array)],
            "getelementptr": [
                (r"getelementptr inbounds \w+, ptr (%arr_\d+), i32 (\S+)", self._local_entry),
                (r"getelementptr inbounds ptr, ptr %params, i32 (\d+)", self._parameter),
                (rf"getelementptr inbounds \w+, ptr ({_NAME}), i64 %index", self._pointer),
                (r"getelementptr \[\d+ x \w+\], ptr @\w+, .*", _ignore),  # zeros
                (rf"getelementptr (?:inbounds )?\[(\d+) x \w+\], {entry}", self._record),
                (rf"getelementptr (?:inbounds )?(?:float|i32|i8), {entry}", self._entry),
            ],
            "load": [
                (rf"load ptr, ptr ({_NAME})", self._pointer),
                (rf"load (\w+), ptr ({_NAME})", self._load_number),
                (rf"load {_VECTOR}, ptr ({_NAME})", self._load_lane),
            ],
            "store": [(rf"store {_VECTOR} (.+?), ptr ({_NAME})", self._store)],
            "extractvalue": [
                (rf"extractvalue \[\d+ x {_VECTOR}\] ({_NAME}), (\d+)", self._extract)
            ],
            # Arithmetic.
            **dict.fromkeys(_BINARY, binary),
            # The index of an entry of a local array times the width of packets.
            "mul": [(rf"mul (i32) (\S+), {self._width}", self._alias), *binary],
            "add": [
                (rf"add {_VECTOR} ({_NAME}), <i32 0, i32 1, .*>", self._alias),  # the lane's index
                (r"add i64 .*", _ignore),
                *binary,
            ],
            **dict.fromkeys(_CONVERSIONS, convert),
            "trunc": [
                (r"trunc i64 %(index|end) to i32", self._lane),
                (rf"(trunc) (i8) ({_NAME}) to (i1)", self._convert),
                *convert,
            ],
            "fneg": [(rf"(fneg) {_VECTOR} (\S+)", self._unary)],
            "fcmp": [(rf"(fcmp \w+) {_VECTOR} {_OPERAND}, {_OPERAND}", self._compare)],
            "icmp": [
                (rf"(icmp \w+) {_VECTOR} {_OPERAND}, {_OPERAND}", self._compare),
                (r"icmp uge i64 .*", _ignore),
                (r"icmp eq i32 .*", _ignore),  # of the indices of a packet
            ],
            "select": [
                (rf"select <\d+ x i1> {_OPERAND}, <\d+ x ptr> ({_NAME}), .*",
                self._set_address_mask),
                (rf"select <\d+ x i1> {_OPERAND}, {_VECTOR} {_OPERAND}, <\d+ x \w+> {_OPERAND}",
                self._select),
            ],
            "call": [
                (r"call i1 @llvm\.vector\.reduce\.or\.v\d+i1\(<\d+ x (i1)> (\S+)\)", self._alias),
                (r"call i32 @llvm\.vector\.reduce\.umin\..*", _ignore),  # of indices
                (r"call i32 @llvm\.vector\.reduce\.umax\.\w+\(<\d+ x (i32)> (\S+)\)", self._alias),
                (r"call (?:fastcc )?\[\d+ x <\d+ x \w+>\] @gather_\d+x\w+\(<\d+ x ptr> "
                 rf"({_NAME})\)", self._gather_record),
                (rf"call {_VECTOR} @llvm\.masked\.gather\S*\(<\d+ x ptr> ({_NAME}), i32 \d+, "
                 rf"<\d+ x i1> {_OPERAND}, <\d+ x \w+> \S+\)", self._gather),
                (r"call <\d+ x i1> @llvm\.x86\.avx512\.(fpclass)\S*\(<\d+ x (float)> (\S+), "
                 r"i32 (\d+)\)", self._class),
                (rf"call {_VECTOR} @llvm\.([\w.]+)\((.*)\)", self._call),
            ],
        }  # fmt: skip

    # The actions of the grammar.

    def _test(self, condition: str) -> None:
        """Note the condition under which the current loop goes on. The instruction is the branch to
        the loop's body, "br i1 %condition, ..."."""
        loop = self._open[-1][0]
        assert isinstance(loop, Loop)
        loop.condition = self._value(condition, "bool")

    def _branch_test(self, condition: str) -> None:
        """Note the condition of the next branch. The instruction is "br i1 %condition, ..."."""
        self._branch_condition = self._value(condition, "bool")

    def _branch_result(self, result: str, element: str, value: str) -> None:
        """Add a result to the branch that has ended, such as "%result = phi <8 x float> [ %value,
        ... ], [ undef, ... ]". element: its LLVM type, such as "float"."""
        assert self._branch is not None
        kind = self._kind(element)
        self._branch.results.append(BranchResult(result, kind, self._value(value, kind)))

    def _phi(self, result: str, element: str, before: str, after: str) -> None:
        """Add a variable to the current loop, such as "%result = phi <8 x float> [ %before, ... ],
        [ %after, ... ]". The two operands are its values before the first iteration and after each
        iteration. element: its LLVM type, such as "float"."""
        kind = self._kind(element)
        # The value after an iteration stays text here: its definition comes later, in the body.
        variable = LoopVariable(result, kind, self._value(before, kind), after)
        loop = self._open[-1][0] if self._open else None
        if not isinstance(loop, Loop):
            raise UntranslatableError(f"{result} belongs to no loop that is translated")
        loop.variables.append(variable)

    def _alias(self, result: str, element: str, value: str) -> None:
        """Note that the result of an instruction is another name of a value, as in "%result =
        shufflevector <8 x float> %value, ...", which copies a value to all lanes. element: the
        value's LLVM type, such as "float"."""
        if element != "ptr":
            self._aliases[result] = self._value(value, self._kind(element))

    def _lane(self, result: str, name: str) -> None:
        """Note that the result of "%result = trunc i64 %name to i32" is the index of the lane, if
        `name` is "index", or the number of lanes."""
        self._aliases[result] = "lane" if name == "index" else "count"

    def _parameter(self, result: str, number: str) -> None:
        """Note that the result of an instruction is the address of the array of kernel parameter
        `number`. The current label is the label of this array."""
        self._addresses[result] = _Address(int(number))
        self._label_parameter(int(number))

    def _pointer(self, result: str, pointer: str) -> None:
        """Note that the result of an instruction is another name of the address `pointer`."""
        self._addresses[result] = self._addresses[pointer]

    def _load_number(self, result: str, element: str, pointer: str) -> None:
        """Append a statement for "%result = load float, ptr %pointer": it loads the only entry of
        an array. element: its LLVM type, here "float"."""
        source = self._addresses[pointer]
        self._current_block.append(Load(result, self._kind(element), "number", source.parameter))

    def _local_array(self, result: str, element: str, count: str) -> None:
        """Note a local array. The instruction is "%result = alloca float, i32 count", for a packet.
        element: the LLVM type of its numbers, here "float"."""
        size = int(count) // self._width
        self.local_arrays[result] = LocalArray(result, self._kind(element), size)

    def _local_entry(self, result: str, array: str, place: str) -> None:
        """Note that the result of "%result = getelementptr inbounds float, ptr %array, i32 place"
        is the address of an entry of a local array. place: a number, which the width divides; or
        the name of a product with the width, which is another name of the index of the entry."""
        index = self._value(place, "u32")
        if isinstance(index, Constant):
            index = Constant("u32", index.bits // self._width)
        self._local_addresses[result] = _LocalAddress(array, index)

    def _load_lane(self, result: str, element: str, pointer: str) -> None:
        """Append a statement for "%result = load <8 x float>, ptr %pointer": it loads the lane's
        entry of an array, or an entry of a local array. element: its LLVM type, here "float"."""
        kind = self._kind(element)
        if (local := self._local_addresses.get(pointer)) is not None:
            self._current_block.append(LocalLoad(result, kind, local.array, local.index))
            return
        source = self._addresses[pointer]
        self._current_block.append(Load(result, kind, "lane", source.parameter))

    def _store(self, element: str, value: str, pointer: str) -> None:
        """Append a statement for "store <8 x float> %value, ptr %pointer": it stores a value as the
        lane's entry of an array, or as an entry of a local array. element: its LLVM type, here
        "float"."""
        kind = self._kind(element)
        stored = self._value(value, kind)
        if (local := self._local_addresses.get(pointer)) is not None:
            self._current_block.append(LocalStore(local.array, local.index, stored))
        else:
            self._current_block.append(Store(self._addresses[pointer].parameter, kind, stored))

    def _record(self, result: str, stride: str, pointer: str, index: str) -> None:
        """Note that the result of "%result = getelementptr [stride x float], ptr %pointer, <8 x
        i32> %index" is the address of record `index` in a table of records of `stride` numbers."""
        source = self._addresses[pointer]
        self._addresses[result] = _Address(source.parameter, self._value(index, "u32"), int(stride))

    def _set_address_mask(self, result: str, mask: str, pointer: str) -> None:
        """Note that the result of "%result = select <8 x i1> %mask, <8 x ptr> %pointer, ..." is the
        address `pointer`, to be read only if `mask` is True."""
        source = self._addresses[pointer]
        self._addresses[result] = _Address(
            source.parameter, source.index, source.stride, self._value(mask, "bool")
        )

    def _entry(self, result: str, pointer: str, index: str) -> None:
        """Note that the result of "%result = getelementptr float, ptr %pointer, <8 x i32> %index"
        is the address of entry `index` of a table."""
        self._record(result, "1", pointer, index)

    def _gather_record(self, result: str, pointer: str) -> None:
        """Note that the result of a call of Dr.Jit's function gather_...(%pointer) holds all
        numbers of the record at the address `pointer`. `_extract` reads them one by one."""
        self._records[result] = self._addresses[pointer]

    def _extract(self, result: str, element: str, record: str, entry: str) -> None:
        """Append a statement for "%result = extractvalue [4 x <8 x float>] %record, entry": it
        loads number `entry` of a record. element: its LLVM type, here "float"."""
        source = self._records[record]
        self._read_table(result, element, source, int(entry), source.mask)

    def _gather(self, result: str, element: str, pointer: str, mask: str) -> None:
        """Append a statement for "%result = call <8 x float> @llvm.masked.gather(%pointer, ...,
        %mask, ...)": it loads the entry of a table at an address if the mask is True, otherwise 0.
        The current label belongs to the result, and becomes the label of the table. element: the
        LLVM type of the entry, here "float"."""
        source = self._addresses[pointer]
        self._read_table(result, element, source, 0, self._value(mask, "bool"))
        self._label_parameter(source.parameter)

    def _read_table(
        self, result: str, element: str, source: _Address, entry: int, mask: Operand | None
    ) -> None:
        """Append a statement that loads number `entry` of the record at the address `source` if
        `mask` is True or None, otherwise 0. The table is noted for the result, as a later
        instruction may bring its label.

        result: the name of the result.
        element: the LLVM type of the number, such as "float".
        """
        kind = self._kind(element)
        load = Load(
            result, kind, "table", source.parameter, source.index, source.stride, entry, mask
        )
        self._current_block.append(load)
        self._tables[result] = source.parameter

    def _arithmetic(self, result: str, name: str, element: str, a: str, b: str) -> None:
        """Append the operation for an instruction such as "%result = fadd <8 x float> %a, %b",
        whose name is "fadd". The operands have the type of the result. element: this LLVM type,
        here "float"."""
        kind = self._kind(element)
        self._emit(result, kind, name, self._value(a, kind), self._value(b, kind))

    def _unary(self, result: str, name: str, element: str, a: str) -> None:
        """Append the operation for an instruction such as "%result = fneg <8 x float> %a", whose
        name is "fneg". element: the LLVM type of operand and result, here "float"."""
        kind = self._kind(element)
        self._emit(result, kind, name, self._value(a, kind))

    def _compare(self, result: str, name: str, element: str, a: str, b: str) -> None:
        """Append the comparison for an instruction such as "%result = fcmp olt <8 x float> %a, %b",
        whose name is "fcmp olt". element: the LLVM type of the operands, here "float"."""
        kind = self._kind(element)
        self._emit(result, "bool", name, self._value(a, kind), self._value(b, kind))

    def _select(self, result: str, mask: str, element: str, a: str, b: str) -> None:
        """Append the operation for "%result = select <8 x i1> %mask, <8 x float> %a, <8 x float>
        %b": the result is a if the mask is True, otherwise b. element: the LLVM type of a and b,
        here "float"."""
        kind = self._kind(element)
        values = self._value(mask, "bool"), self._value(a, kind), self._value(b, kind)
        self._emit(result, kind, "select", *values)

    def _convert(self, result: str, name: str, source_type: str, a: str, target_type: str) -> None:
        """Append the conversion for an instruction such as "%result = sitofp <8 x i32> %a to <8 x
        float>", whose name is "sitofp" and whose source and target types are "i32" and "float".

        A bitcast between equal types only gives a value another name. If a value that was read from
        a table is bitcast, the current label becomes the label of the table.
        """
        kind, source_kind = self._kind(target_type), self._kind(source_type)
        value = self._value(a, source_kind)
        if name == "bitcast" and isinstance(value, str):
            if value in self._tables:
                self._label_parameter(self._tables[value])
            if kind == source_kind:
                self._aliases[result] = value
                return
        self._emit(result, kind, f"{name} {source_kind}", value)

    def _class(self, result: str, name: str, element: str, value: str, mask: str) -> None:
        """Append a test whether a float belongs to certain classes (NaN, infinity, zero and so on).
        It is a call of AVX-512's function `fpclass`.

        result, name, element, value: the name of the result, "fpclass", the LLVM type "float", and
            the operand.
        mask: the classes as bits.
        """
        self._emit(result, "bool", f"{name} {mask}", self._value(value, self._kind(element)))

    def _call(self, result: str, element: str, function: str, arguments: str) -> None:
        """Append the operation that stands for a call of an LLVM function, such as "%result = call
        <8 x float> @llvm.sqrt.v8f32(<8 x float> %a)". The function here is "sqrt.v8f32". arguments:
        their text. element: the LLVM type of the result, here "float".

        Raises:
            UntranslatableError: the function is unknown.
        """
        kind = self._kind(element)
        operands = re.findall(r"<\d+ x \w+> (<[^>]*>|[^,\s]+)", arguments)
        # The name of the function without the types and sizes of its operands.
        stem = re.sub(r"\.(?:v\d+\w*|ps|f32|i32|ss)\b.*", "", function)
        if stem in _UNARY_CALLS:
            self._emit(result, kind, _UNARY_CALLS[stem], self._value(operands[0], kind))
        elif len(operands) == _CALLS.get(stem, -1):  # -1: an unknown function
            self._emit(result, kind, stem, *(self._value(operand, kind) for operand in operands))
        else:
            raise UntranslatableError(
                f"a kernel of this field calls {function}, which is not translated for other GPUs"
            )

    @staticmethod
    def _kind(element: str) -> Kind:
        """Return the type that numbers of an LLVM type have in the parsed program: "f32" for
        "float", "u32" for "i32" and so on. element: the LLVM type.

        Raises:
            UntranslatableError: other GPUs do not have the type, such as double precision.
        """
        if element not in _KINDS:
            raise UntranslatableError(
                f"a kernel of this field computes with numbers of type {element}: other GPUs have "
                "single precision alone"
            )
        return _KINDS[element]
