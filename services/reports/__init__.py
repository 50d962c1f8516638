"""Reports as documents, tables, figures and pages."""
