"""Sums over sources (edges of curves, triangles, dipoles) at points: directly, by trees with
multipoles (treecodes), and by cells with local expansions (the fast multipole method, FMM). They
have proved bounds of their truncation and rounding errors. Fields are made of them in
`fields.solid_angles`; nothing here knows a field."""
