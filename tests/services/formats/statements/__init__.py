"""Files that make one statement each, by reader: the cells of `test_statement_matrix.py`."""
