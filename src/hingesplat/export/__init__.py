"""Writers: a ``Twin`` in, files out."""
