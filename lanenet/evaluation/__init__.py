"""Any detector on any labelled source: errors, tables, pictures, robustness, and the model card."""
