"""The speed figures, each beside the fastest this machine can do."""
