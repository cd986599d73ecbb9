"""Translates recorded kernels to WGSL, WebGPU's language. A kernel is a program that runs once for
each lane, that is for each entry of its arrays; `llvm_parser` has parsed it into statements
(`kernel`), whose operands are constants or results of earlier statements. The WGSL program is
called a shader. A kernel's parameters are its arrays, and a label is the name of an array.

WGSL promises less than LLVM: division may be off by 2.5 units in the last place, `fma` may round
twice, subnormal numbers may be zero, and a compiler may assume that infinities and NaN do not
occur. So constants that are not finite are computed from a word that is read from a buffer, NaN and
infinity are recognized by their bits, and the results of a device are compared with Dr.Jit's
(`harnack.webgpu.device`).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from harnack.webgpu.kernel import (
    Branch,
    ComputeKernel,
    Constant,
    Load,
    LocalArray,
    LocalLoad,
    LocalStore,
    Loop,
    Operand,
    Operation,
    Statement,
    Store,
    UntranslatableError,
)

WORKGROUP = 64

_PRELUDE = """\
@group(0) @binding(0) var<storage, read> data: array<u32>;
@group(0) @binding(1) var<storage, read> lanes: array<u32>;
@group(0) @binding(2) var<storage, read_write> results: array<u32>;

fn is_nan(x: f32) -> bool {
  return (bitcast<u32>(x) & 0x7fffffffu) > 0x7f800000u;
}
fn min_number(x: f32, y: f32) -> f32 {
  return select(x, y, (y < x) | is_nan(x));
}
fn max_number(x: f32, y: f32) -> f32 {
  return select(x, y, (y > x) | is_nan(x));
}
fn min_or_nan(x: f32, y: f32) -> f32 {
  return select(x, y, ((y < x) | is_nan(y)) & !is_nan(x));
}
fn max_or_nan(x: f32, y: f32) -> f32 {
  return select(x, y, ((y > x) | is_nan(y)) & !is_nan(x));
}
fn to_signed(x: f32) -> u32 {
  return bitcast<u32>(i32(x));
}
"""

_INFIX = {
    "fadd": "+", "fsub": "-", "fmul": "*", "fdiv": "/", "add": "+", "sub": "-", "mul": "*",
    "udiv": "/", "urem": "%",
}  # fmt: skip
# Operators on bits, and on truth values; "&&" and "||" would be branches.
_BIT_OPERATORS = {"and": ("&", "&"), "or": ("|", "|"), "xor": ("^", "!=")}
_FUNCTIONS = {
    "sqrt": "sqrt", "abs": "abs", "floor": "floor", "ceil": "ceil", "trunc": "trunc",
    "round": "round", "rsqrt": "inverseSqrt", "fma": "fma", "fmuladd": "fma",
    "minnum": "min_number", "maxnum": "max_number", "minimum": "min_or_nan",
    "maximum": "max_or_nan", "umin": "min", "umax": "max", "popcount": "countOneBits",
}  # fmt: skip
_COMPARISONS = {"eq": "==", "ne": "!=", "gt": ">", "ge": ">=", "lt": "<", "le": "<="}
_NEGATED_COMPARISONS = {"gt": "le", "ge": "lt", "lt": "ge", "le": "gt"}


@dataclass(frozen=True)
class Shader:
    """A kernel in WGSL, and the layout of its buffers (arrays in the GPU's memory). All fields
    except `code` are labels of arrays, in the order of the buffers.

    The buffer of data holds 32-bit words: the number of lanes; 0; the start of each table; each
    number; then the tables. The buffer of lanes holds the arrays `lanes`, one after the other, with
    an entry per lane. The buffer of results holds the arrays `results` in the same way.

    numbers, tables: arrays with a single entry, and arrays read at computed indices.
    """

    code: str
    numbers: tuple[str, ...]
    tables: tuple[str, ...]
    lanes: tuple[str, ...]
    results: tuple[str, ...]


def to_shader(kernel: ComputeKernel) -> Shader:
    """Translate a kernel to WGSL.

    Raises:
        UntranslatableError: an operation is unknown; or an array has no label, by which the caller
            could pass its contents to the shader.
    """
    return _WGSLWriter(kernel).shader()


class _WGSLWriter:
    """Writes a kernel as a shader, a program in WGSL, statement by statement. Each result of a
    statement becomes a variable of the shader. Arrays are in three buffers: "data" (single numbers
    and tables) and "lanes" (arrays with an entry per lane) are read, "results" is written.

    _buffer_slots: for "number", "table" and "lane", the kernel parameters of this kind in the order
        of the buffers.
    _stores: the statements that store results, in the order of the results buffer.
    _lines, _depth: the lines of code so far, and the depth of indentation.
    """

    def __init__(self, kernel: ComputeKernel) -> None:
        self._kernel = kernel
        # The parameters of each kind, each of them once.
        slots: dict[str, list[int]] = {"number": [], "table": [], "lane": []}
        self._stores: list[Store] = []
        for statement in kernel.walk():
            if isinstance(statement, Load) and statement.parameter not in slots[statement.source]:
                slots[statement.source].append(statement.parameter)
            elif isinstance(statement, Store):
                self._stores.append(statement)
        self._buffer_slots = {source: sorted(parameters) for source, parameters in slots.items()}
        self._stores.sort(key=lambda statement: statement.parameter)
        self._lines: list[str] = []
        self._depth = 1

    def shader(self) -> Shader:
        """Write the whole kernel, and return the shader."""
        for array in self._kernel.local_arrays:
            self._declare(array)
        for statement in self._kernel.statements:
            self._write(statement)
        names = {
            source: tuple(self._label(parameter) for parameter in parameters)
            for source, parameters in self._buffer_slots.items()
        }
        results = tuple(self._label(statement.parameter) for statement in self._stores)
        # Workgroups form a rectangle, since each axis is limited. The words `count` and `zero` are
        # the number of lanes, and a 0 that the compiler does not know.
        code = "\n".join(
            [
                _PRELUDE,
                f"@compute @workgroup_size({WORKGROUP})",
                "fn main(",
                "  @builtin(global_invocation_id) id: vec3<u32>,",
                "  @builtin(num_workgroups) groups: vec3<u32>",
                ") {",
                f"  let lane = id.x + id.y * groups.x * {WORKGROUP}u;",
                "  let count = data[0];",
                "  let zero = data[1];",
                "  if (lane >= count) { return; }",
                *self._lines,
                "}",
                "",
            ]
        )
        return Shader(code, names["number"], names["table"], names["lane"], results)

    def _label(self, parameter: int) -> str:
        """Return the label of the array of a kernel parameter.

        Raises:
            UntranslatableError: it has none.
        """
        label = self._kernel.labels.get(parameter)
        if label is None:
            raise UntranslatableError(f"parameter {parameter} of a kernel has no name")
        return label

    def _emit(self, line: str) -> None:
        """Append a line of code, indented."""
        self._lines.append("  " * self._depth + line)

    def _declare(self, array: LocalArray) -> None:
        """Append the declaration of a local array."""
        self._emit(f"var {_variable(array.name)}: array<{array.kind}, {array.size}>;")

    def _write(self, statement: Statement) -> None:
        """Append the code of a statement."""
        if isinstance(statement, Loop):
            self._loop(statement)
        elif isinstance(statement, Branch):
            self._branch(statement)
        elif isinstance(statement, LocalLoad):
            self._emit(f"let {_variable(statement.result)} = {self._local_entry(statement)};")
        elif isinstance(statement, LocalStore):
            self._emit(f"{self._local_entry(statement)} = {self._operand_text(statement.value)};")
        elif isinstance(statement, Store):
            slot = self._stores.index(statement)
            value = self._operand_text(statement.value)
            bits = value if statement.kind == "u32" else f"bitcast<u32>({value})"
            self._emit(f"results[{slot}u * count + lane] = {bits};")
        elif isinstance(statement, Load):
            self._emit(f"let {_variable(statement.result)} = {self._load(statement)};")
        else:
            self._emit(f"let {_variable(statement.result)} = {self._operation(statement)};")

    def _loop(self, loop: Loop) -> None:
        """Append the code of a loop: its variables with their first values, the test, the body, and
        the assignment of new values."""
        for node in loop.variables:
            self._emit(
                f"var {_variable(node.name)}: {node.kind} = {self._operand_text(node.before)};"
            )
        self._emit("loop {")
        self._depth += 1
        for node in loop.test:
            self._write(node)
        self._emit(f"if (!{self._operand_text(loop.condition)}) {{ break; }}")
        for node in loop.body:
            self._write(node)
        changed_variables = [node for node in loop.variables if node.after != node.name]
        # All new values are computed first: one may be the old value of another variable.
        for node in changed_variables:
            self._emit(f"let next_{_variable(node.name)} = {self._operand_text(node.after)};")
        for node in changed_variables:
            self._emit(f"{_variable(node.name)} = next_{_variable(node.name)};")
        self._depth -= 1
        self._emit("}")

    def _branch(self, branch: Branch) -> None:
        """Append the code of a branch: its results, which are 0 at first, and its body, which
        assigns to them."""
        for result in branch.results:
            self._emit(f"var {_variable(result.name)}: {result.kind};")
        self._emit(f"if ({self._operand_text(branch.condition)}) {{")
        self._depth += 1
        for node in branch.body:
            self._write(node)
        for result in branch.results:
            self._emit(f"{_variable(result.name)} = {self._operand_text(result.value)};")
        self._depth -= 1
        self._emit("}")

    def _local_entry(self, access: LocalLoad | LocalStore) -> str:
        """Return the WGSL expression of the entry of a local array that a statement accesses."""
        return f"{_variable(access.array)}[{self._operand_text(access.index)}]"

    def _load(self, load: Load) -> str:
        """Return the WGSL expression that reads an entry of an array from a buffer (`Shader`
        describes the layout)."""
        place = self._buffer_slots[load.source].index(load.parameter)
        if load.source == "lane":
            bits = f"lanes[{place}u * count + lane]"
        # Two words and the starts of all tables precede the numbers.
        elif load.source == "number":
            bits = f"data[{2 + len(self._buffer_slots['table']) + place}]"
        else:
            assert load.index is not None
            index = self._operand_text(load.index)
            # The table consists of records; the offset is the number's place in its record.
            if load.stride > 1:
                index = f"{index} * {load.stride}u + {load.offset}u"
            # The word data[2 + k] is where table k starts.
            bits = f"data[data[{2 + place}] + {index}]"
            # A mask that is constantly true needs no test.
            if load.mask is not None and not (isinstance(load.mask, Constant) and load.mask.bits):
                bits = f"select(0u, {bits}, {self._operand_text(load.mask)})"
        return bits if load.kind == "u32" else f"bitcast<f32>({bits})"

    def _operation(self, operation: Operation) -> str:
        """Return the WGSL expression of an operation. Integers are unsigned in the shader; signed
        operations reinterpret their bits.

        The name of an operation may be followed by a variant: the predicate of a comparison ("fcmp
        olt"), the classes of a test, or the source type of a conversion.
        """
        # The expressions of the operands.
        a = [self._operand_text(value) for value in operation.operands]
        name, _, variant = operation.name.partition(" ")
        if name in _INFIX:
            return f"{a[0]} {_INFIX[name]} {a[1]}"
        # The second operator of a pair is for truth values.
        if name in _BIT_OPERATORS:
            return f"{a[0]} {_BIT_OPERATORS[name][operation.kind == 'bool']} {a[1]}"
        if name in _FUNCTIONS and not variant:  # with a variant, "trunc" is a conversion
            return f"{_FUNCTIONS[name]}({', '.join(a)})"
        match name:
            case "fneg":
                return f"-{a[0]}"
            case "rcp":
                return f"1.0f / {a[0]}"
            case "shl":
                return f"{a[0]} << ({a[1]} & 31u)"
            case "lshr":
                return f"{a[0]} >> ({a[1]} & 31u)"
            case "ashr":
                return f"bitcast<u32>({_as_signed(a[0])} >> ({a[1]} & 31u))"
            case "sdiv" | "srem":
                operator = "/" if name == "sdiv" else "%"
                return f"bitcast<u32>({_as_signed(a[0])} {operator} {_as_signed(a[1])})"
            case "smin" | "smax":  # WGSL's min and max
                return f"bitcast<u32>({name[1:]}({_as_signed(a[0])}, {_as_signed(a[1])}))"
            case "iabs":
                return f"bitcast<u32>(abs({_as_signed(a[0])}))"
            # The bits of the first number without its sign, and the sign of the second.
            case "copysign":
                return (
                    f"bitcast<f32>((bitcast<u32>({a[0]}) & 0x7fffffffu) | "
                    f"(bitcast<u32>({a[1]}) & 0x80000000u))"
                )
            # WGSL's select has the value for False first.
            case "select":
                return f"select({a[2]}, {a[1]}, {a[0]})"
            case "fpclass":
                return _float_class_test(int(variant), a[0])
            case "fcmp":
                return _float_comparison(variant, a[0], a[1])
            case "icmp":
                if variant in ("eq", "ne"):
                    return f"{a[0]} {_COMPARISONS[variant]} {a[1]}"
                # Predicates such as "slt" compare signed integers, "ult" unsigned ones.
                x, y = (_as_signed(v) for v in a) if variant[0] == "s" else a
                return f"{x} {_COMPARISONS[variant[1:]]} {y}"
            case _:
                return _conversion(operation, name, variant, a[0])

    def _operand_text(self, value: Operand) -> str:
        """Return the WGSL expression of an operand: a variable, or a constant with exactly its
        bits."""
        if isinstance(value, str):
            return _variable(value)
        if value.kind == "bool":
            return "true" if value.bits else "false"
        if value.kind == "u32":
            return f"{value.bits}u"
        # The float that has these bits, and its biased exponent.
        number: float = struct.unpack("<f", struct.pack("<I", value.bits))[0]
        exponent = (value.bits >> 23) & 255
        # Infinity or NaN. A compiler must not know the bits, so a zero from a buffer is mixed in.
        if exponent == 255:
            return f"bitcast<f32>({value.bits}u ^ zero)"
        # A subnormal number, whose decimal form a compiler might round to 0.
        if exponent == 0 and value.bits:
            return f"bitcast<f32>({value.bits}u)"
        # Negative numbers and -0 stand in brackets, as an operator may precede them.
        return f"{number!r}f" if number >= 0 and value.bits >> 31 == 0 else f"({number!r}f)"


def _variable(result: str) -> str:
    """Return the name of the WGSL variable for a result's name in LLVM, such as v_r12 for %r12."""
    return result.replace("%", "v_").replace(".", "_")


def _as_signed(text: str) -> str:
    """Return the WGSL expression that reinterprets an expression's bits as a signed integer."""
    return f"bitcast<i32>({text})"


def _float_comparison(predicate: str, x: str, y: str) -> str:
    """Return the WGSL expression that compares two floats x and y by an LLVM predicate. Predicates
    that begin with "o" (ordered) are false if an operand is NaN; those that begin with "u"
    (unordered) are true. "ord" and "uno" test only whether no operand is NaN, or any.

    WGSL's own <, <=, >, >= and == are false for NaN, as ordered comparisons are. An unordered
    inequality is the negation of the opposite one: "ult" is !(x >= y). WGSL's != is true for NaN.
    Equality and inequality ("ueq", "one", "une") test for NaN by its bits.
    """
    if predicate in ("ord", "uno"):
        any_nan = f"is_nan({x}) | is_nan({y})"
        return any_nan if predicate == "uno" else f"!({any_nan})"
    # The texts are equal: a number is compared with itself, which is a test for NaN.
    if x == y and predicate in ("oeq", "une"):
        return f"is_nan({x})" if predicate == "une" else f"!is_nan({x})"
    first_letter, order = predicate[0], predicate[1:]
    if predicate == "ueq":
        return f"({x} == {y}) | is_nan({x}) | is_nan({y})"
    if predicate == "one":
        return f"({x} != {y}) & !is_nan({x}) & !is_nan({y})"
    if predicate == "une":
        return f"({x} != {y}) | is_nan({x}) | is_nan({y})"
    if first_letter == "o":
        return f"{x} {_COMPARISONS[order]} {y}"
    return f"!({x} {_COMPARISONS[_NEGATED_COMPARISONS[order]]} {y})"


def _float_class_test(classes: int, x: str) -> str:
    """Return the WGSL expression that tests whether the float x belongs to one of some classes
    (NaN, zeros, infinities, subnormal numbers).

    classes: their bits, as in AVX-512's `fpclass`.

    Raises:
        UntranslatableError: no class, or negative numbers.
    """
    bits = f"bitcast<u32>({x})"
    # By the bits of `classes`: NaN, quiet or signaling; 0; -0; infinity; -infinity; subnormal.
    tests = {
        0x81: f"is_nan({x})",
        0x02: f"({bits} == 0u)",
        0x04: f"({bits} == 0x80000000u)",
        0x08: f"({bits} == 0x7f800000u)",
        0x10: f"({bits} == 0xff800000u)",
        # Bits from 1 to 0x7fffff: for 0, the subtraction gives the largest integer.
        0x20: f"((({bits} & 0x7fffffffu) - 1u) < 0x7fffffu)",
    }
    if classes & 0x40 or not classes:
        raise UntranslatableError(f"fpclass {classes} is not translated for other GPUs")
    return " | ".join(test for mask, test in tests.items() if classes & mask)


def _conversion(operation: Operation, name: str, source: str, x: str) -> str:
    """Return the WGSL expression of a conversion, which converts x to the type of the operation.

    name: the LLVM conversion, such as "sitofp" (signed integer to float).
    source: the type of x: "f32", "u32" or "bool".

    Raises:
        UntranslatableError: the conversion is unknown.
    """
    match name, source, operation.kind:
        case "bitcast", _, kind:
            return x if source == kind else f"bitcast<{kind}>({x})"
        case "sitofp", "u32", _:
            return f"f32({_as_signed(x)})"
        case "uitofp", "u32" | "bool", _:
            return f"f32({x})"
        case "fptosi", _, _:
            return f"to_signed({x})"
        case "fptoui", _, _:
            return f"u32({x})"
        # Extended with its sign, True becomes an integer of ones.
        case "sext", "bool", _:
            return f"select(0u, 0xffffffffu, {x})"
        case "zext", "bool", _:
            return f"select(0u, 1u, {x})"
        case "trunc", "u32", "bool":
            return f"({x} & 1u) != 0u"
        case "zext" | "trunc", "u32", "u32":
            return x
        case _:
            raise UntranslatableError(
                f"{operation.name} to {operation.kind} is not translated for other GPUs"
            )
