"""What the documents' tables hold, made from rows; `experiments.report` puts them there."""
