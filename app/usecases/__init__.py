"""What a user can ask for: one function each, shared by the API, the command line and the worker."""
