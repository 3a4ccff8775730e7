"""Stage: the hand and objects as rigid bodies with contacts, simulated by MuJoCo."""
