"""Many runs: suites, the queue, and the executors that run them."""
