"""Self-contained HTML pages: scale -> svg -> page -> one module a kind of report."""
