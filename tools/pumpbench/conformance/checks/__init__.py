"""The checks, a module per group of requirements; each is a black-box test over the wire."""
