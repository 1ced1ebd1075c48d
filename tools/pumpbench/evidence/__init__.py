"""The evidence page: what runs and conformance results show, for a reader who was not there and has not this tool."""
