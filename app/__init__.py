"""The entry points and the store, around the science of `amers.services`."""
