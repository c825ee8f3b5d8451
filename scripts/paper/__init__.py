"""The report that tests the paper's claims."""
