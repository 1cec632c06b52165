"""What was measured: the `Recording`, the file formats it is read from, and findings about its quality.

`recording` defines the data, `reading` reads files in the `formats`, `columns` makes a recording from plain columns,
and `findings` and `quality` report problems.
"""
