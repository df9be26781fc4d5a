"""The search for effects step by step: one is selected and adopted by a joint refit, others give way, and again."""
