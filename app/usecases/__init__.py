"""What a user can request: one function each, shared by the API, the command line and the worker."""
