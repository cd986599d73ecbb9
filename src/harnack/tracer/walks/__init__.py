"""Rays station by station: trial points, sheets, parts; followed together, or by a queue."""
