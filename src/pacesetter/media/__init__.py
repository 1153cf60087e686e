"""Pictures of a run and its policy, and the policy in the forms of other programs."""
