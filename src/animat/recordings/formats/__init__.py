"""File formats of recordings, one module each.

A reader raises InvalidFile, naming the file, if that is missing, damaged or lacks something, and UnusableData, naming
the column, for values that cannot be; `hdf5_file` and `animat.recordings.reading` add the file's name.

To add a format, write `read_<format>` in a new module, build the recording with `animat.recordings.columns` if the file
has plain arrays, and make `animat.recordings.reading` detect it by its content.
"""
