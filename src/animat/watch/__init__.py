"""The live page: shows the contents of a folder in a browser on this machine, while it grows or afterwards."""
