"""File formats of recordings: one module per format, each with `read_<format>` (and `write_<format>` for our own, NWB).

To add a format, write `read_<format>(path) -> Recording` in a new module, build the recording with
`animat.recordings.columns` if the file has plain arrays, and make `animat.recordings.reading` detect it by its content.
"""
