"""Speed and evaluation counts, measured as ratios in one run. `python -m benchmarks` writes the
tables and plots into docs/benchmarks.md."""
