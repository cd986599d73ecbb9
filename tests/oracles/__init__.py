"""What tests and benchmarks hold the package against: other formulas, in double precision.

They share no code with what they judge. `harnack.testing` has the checks that users run on their
own fields and bounds.
"""
