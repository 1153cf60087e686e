"""Many runs: start them, tune them, compare them."""
