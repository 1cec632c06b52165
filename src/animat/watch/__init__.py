"""The live page: what a folder holds, shown in a browser on this machine while it grows, or afterwards."""
