"""Sums over sources (edges of curves, triangles, dipoles) at points: directly, by trees with
multipoles (treecodes), and by cells with local expansions (the fast multipole method, FMM). They
have proved bounds of their truncation and rounding errors. Fields are made of them in
`fields.solid_angles`; nothing here knows a field.

Sources are dipoles, and what is a sum of dipoles: triangles and curves. A new kind of source, such
as a mass, is a file here, beside `radial_tree`; `treecode` and `source_sums` say which of their
parts serve it. A field that is made of it goes into `fields.solid_angles` if it shares the code of
fields there, and into `fields.blobs` if not."""
