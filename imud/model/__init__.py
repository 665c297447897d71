"""Nouns of imud: units, errors, sample, event, ledger, options."""
