"""Makes the documents' tables from rows; `experiments.report` puts them into the documents."""
