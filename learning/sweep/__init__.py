"""Sweeps: methods x controllers x seeds from one file, run side by side, and their table.

`load_sweep` reads a file, and the `SweepConfig` that it gives says which runs there are; `run_all`
gives them to processes (`LocalPool`) or to a Ray cluster (`RayPool`); each leaves its folder;
`collect` makes one JSON of what is there, and `learning.sweep.table.markdown_table` a table of
that, without the extra "learning".
"""
