"""What is read of Dr.Jit's kernels, and what is written of it."""

from __future__ import annotations

import math
import re

import pytest

from harnack.webgpu import UntranslatableError
from harnack.webgpu.kernel import Branch, Constant, Load, Loop, Operation
from harnack.webgpu.llvm_parser import parse
from harnack.webgpu.wgsl import to_shader

# One number read, one operation, one result.
KERNEL = """
define void @drjit_0123(i64 %start, i64 %end, i32 %thread_id, ptr noalias %params) #0 {{
entry:
    br label %body

body:
    %index = phi i64 [ %index_next, %suffix ], [ %start, %entry ]
    ; lane x
    %f1_p1 = getelementptr inbounds ptr, ptr %params, i32 3
    %f1_p2 = load ptr, ptr %f1_p1, align 8, !alias.scope !2
    %f1_p3 = getelementptr inbounds float, ptr %f1_p2, i64 %index
    %f1 = load <16 x float>, ptr %f1_p3, align 64, !alias.scope !2
{}
    ; result y
    %f2_p1 = getelementptr inbounds ptr, ptr %params, i32 4
    %f2_p2 = load ptr, ptr %f2_p1, align 8, !alias.scope !2
    %f2_p3 = getelementptr inbounds float, ptr %f2_p2, i64 %index
    store <16 x float> %f2, ptr %f2_p3, align 64, !alias.scope !2
    br label %suffix

suffix:
    %index_next = add i64 %index, 16
    %cond = icmp uge i64 %index_next, %end
    br i1 %cond, label %done, label %body, !llvm.loop !5

done:
    ret void
}}
"""


def translated(*lines: str) -> str:
    return to_shader(parse(KERNEL.format("\n".join(f"    {line}" for line in lines)))).code


@pytest.mark.parametrize(("line", "written"), [
    ("%f2 = fadd <16 x float> %f1, %f1", "v_f1 + v_f1"),
    ("%f2 = fdiv nsz contract <16 x float> %f1, %f1", "v_f1 / v_f1"),
    ("%f2 = fneg <16 x float> %f1", "-v_f1"),
    ("%f2 = call <16 x float> @llvm.fma.v16f32(<16 x float> %f1, <16 x float> %f1, "
     "<16 x float> %f1)", "fma(v_f1, v_f1, v_f1)"),
    ("%f2 = call <4 x float> @llvm.sqrt.v4f32(<4 x float> %f1)", "sqrt(v_f1)"),
    ("%f2 = fadd <2 x float> %f1, <float 0x7FF0000000000000, float 0x7FF0000000000000>",
     "bitcast<f32>(2139095040u ^ zero)"),
    ("%f2 = fadd <2 x float> %f1, <float 0x36A0000000000000, float 0x36A0000000000000>",
     "bitcast<f32>(1u)"),
    ("%f2 = fadd <2 x float> %f1, <float -2.0, float -2.0>", "v_f1 + (-2.0f)"),
])  # fmt: skip
def test_what_is_written(line: str, written: str) -> None:
    assert f"let v_f2 = {written};" in translated(line) or written in translated(line)


@pytest.mark.parametrize("line", [
    "%f2 = fmagic <16 x float> %f1, %f1",
    "%f2 = call <16 x float> @llvm.sin.v16f32(<16 x float> %f1)",
    "%f2 = fadd <16 x double> %f1, %f1",
    "%f2 = call <16 x float> @unheard_of(<16 x float> %f1)",
    "%f2 = atomicrmw add ptr %f1, float 1.0 monotonic",
])  # fmt: skip
def test_what_is_not_known_is_refused_by_name(line: str) -> None:
    with pytest.raises(UntranslatableError, match=r"magic|llvm\.sin|sin|double|unheard_of|atomic"):
        translated(line)


def test_no_kernel() -> None:
    with pytest.raises(UntranslatableError, match="no kernel"):
        parse("define void @main() {\n}")


def test_arrays_keep_their_names() -> None:
    shader = to_shader(parse(KERNEL.format("    %f2 = fneg <16 x float> %f1")))
    assert (shader.lanes, shader.results) == (("lane x",), ("result y",))
    assert (shader.numbers, shader.tables) == ((), ())
    unnamed = KERNEL.replace("; lane x", "").format("    %f2 = fneg <16 x float> %f1")
    with pytest.raises(UntranslatableError, match="no name"):
        to_shader(parse(unnamed))


def test_a_loop_changes_its_variables_at_once() -> None:
    """The two swap places at each turn."""
    kernel = parse(
        KERNEL.format("""
    br label %l_7_before

l_7_before:
    br label %l_7_cond

l_7_cond:
    %f3 = phi <16 x float> [ %f1, %l_7_before ], [ %f4, %l_7_end ]
    %f4 = phi <16 x float> [ zeroinitializer, %l_7_before ], [ %f3, %l_7_end ]
    %p5 = fcmp olt <16 x float> %f3, %f4
    %p5_red = call i1 @llvm.vector.reduce.or.v16i1(<16 x i1> %p5)
    br i1 %p5_red, label %l_7_body, label %l_7_done

l_7_body:
    br label %l_7_end

l_7_end:
    br label %l_7_cond

l_7_done:
    %f2 = fadd <16 x float> %f3, %f4""")
    )
    load, loop, after, _ = kernel.statements
    assert isinstance(load, Load)
    assert isinstance(loop, Loop)
    assert isinstance(after, Operation)
    assert [(one.before, one.after) for one in loop.variables] == [
        ("%f1", "%f4"), (Constant("f32", 0), "%f3"),
    ]  # fmt: skip
    code = to_shader(kernel).code
    assert code.index("let next_v_f4 = v_f3;") < code.index("v_f3 = next_v_f3;")


@pytest.mark.parametrize(("how", "of_nan", "of_order"), [
    ("olt", False, True), ("ult", True, True), ("oge", False, False), ("uge", True, False),
    ("one", False, True), ("une", True, True), ("ord", False, True), ("uno", True, False),
    ("oeq", False, False), ("ueq", True, False),
])  # fmt: skip
def test_comparisons_of_nan(how: str, of_nan: bool, of_order: bool) -> None:
    """As Python would work out what is written, for 1 and 2 and for NaN."""
    code = translated(
        f"%p3 = fcmp {how} <16 x float> %f1, %f4",
        "%f2 = select <16 x i1> %p3, <16 x float> %f1, <16 x float> %f1",
    )
    written = code.split("let v_p3 = ")[1].split(";")[0]
    python = re.sub(r"!(?!=)", "1 - ", written)
    for x, wanted in ((1.0, of_order), (math.nan, of_nan)):
        assert bool(eval(python, {"v_f1": x, "v_f4": 2.0, "is_nan": math.isnan})) is wanted


def test_a_branch_has_the_results_of_its_body() -> None:
    kernel = parse(
        KERNEL.format("""
    %p3 = fcmp ogt <16 x float> %f1, zeroinitializer
    br label %l_7_start

l_7_start:
    %u7_t = call i1 @llvm.vector.reduce.or.v16i1(<16 x i1> %p3)
    br i1 %u7_t, label %l_7_t, label %l_7_next

l_7_t:
    %f4 = fneg <16 x float> %f1
    br label %l_7_t_trailer

l_7_t_trailer:
    br label %l_7_next

l_7_next:
    %f2 = phi <16 x float> [ %f4, %l_7_t_trailer ], [ undef, %l_7_start ]""")
    )
    _, _, branch, _ = kernel.statements
    assert isinstance(branch, Branch)
    assert branch.condition == "%p3"
    assert [(result.name, result.value) for result in branch.results] == [("%f2", "%f4")]
    code = to_shader(kernel).code
    assert "if (v_p3) {\n    let v_f4 = -v_f1;\n    v_f2 = v_f4;\n  }" in code


def test_a_local_array_is_read_at_the_index_of_the_lane() -> None:
    text = KERNEL.format("""
    %r3 = fptoui <16 x float> %f1 to <16 x i32>
    %f2_4 = call i32 @llvm.vector.reduce.umax.v16i32(<16 x i32> %r3)
    br i1 %f2_6, label %l_2_u, label %l_2_n

l_2_u:
    %f2_7 = mul i32 %f2_4, 16
    %f2_8 = getelementptr inbounds float, ptr %arr_1, i32 %f2_7
    %f2_u = load <16 x float>, ptr %f2_8, align 64
    br label %l_2_done

l_2_n:
    %f2_n = what is skipped
    br label %l_2_done

l_2_done:
    %f2 = phi <16 x float> [ %f2_u, %l_2_u ], [ %f2_n, %l_2_n ]""")
    text = text.replace("entry:\n", "entry:\n    %arr_1 = alloca float, i32 80, align 64\n", 1)
    code = to_shader(parse(text)).code
    assert "var v_arr_1: array<f32, 5>;" in code
    assert "let v_f2_u = v_arr_1[v_r3];" in code
