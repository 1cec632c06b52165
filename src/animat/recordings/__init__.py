"""What was measured: the `Recording`, the files it comes from, and what was noticed about it.

`recording` holds the nouns, `reading` reads files in the `formats`, `columns` makes a recording of plain columns,
`findings` and `quality` say what is odd.
"""
