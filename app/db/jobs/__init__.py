"""Jobs, their attempts and their queue in the database."""
