"""Pictures of a run with Matplotlib: for a report, a chat, a machine without a display."""
