"""Many runs: suites, their queue, and where they run."""
