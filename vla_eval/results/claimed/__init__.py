"""Claims of a success rate, and the test whether a policy is as good."""
