"""One module a subject; each has a `router`. What they share comes in through service/dependencies.py."""
