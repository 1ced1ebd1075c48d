"""Two runs side by side: whether they are the same, and if not, where they part and what follows from it."""
