"""A run as a Rerun recording: what is in it, how it looks, its file, and pictures of it. Nothing else knows Rerun."""
