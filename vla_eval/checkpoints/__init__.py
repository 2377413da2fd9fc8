"""Other people's weights: find, check, load, fetch, merge and convert them. Knows no simulators and runs."""
