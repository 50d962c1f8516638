"""Catalogues of images as STAC: items in files, folders, linked catalogues and search APIs."""
