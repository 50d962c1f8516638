"""The worker: it takes jobs from the queue and runs each attempt in a process of its own."""
