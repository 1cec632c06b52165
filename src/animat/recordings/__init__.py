"""What was measured: the `Recording`, the file formats it is read from, and findings about its quality."""
