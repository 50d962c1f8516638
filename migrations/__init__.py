"""Migrations of the store, applied by `amers db upgrade`; each revision says why in one sentence."""
