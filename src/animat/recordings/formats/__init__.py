"""File formats of recordings, one module each.

To add one, write `read_<format>` in a new module, build the recording with `animat.recordings.columns` if the file has
plain arrays, and make `animat.recordings.reading` detect it by its content.
"""
