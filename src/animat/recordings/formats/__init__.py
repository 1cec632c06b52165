"""File formats of recordings: one a file, each with `read_<format>` (and `write_<format>` for NWB, our own).

To add a format, write `read_<format>(path) -> Recording` in a file of its own, build the recording
with `animat.recordings.columns` where the file brings plain arrays, and teach `animat.recordings.reading` to know it
by its content.
"""
