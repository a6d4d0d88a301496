"""Steps of an identification: each proposes a change, and motions that were not fitted judge it."""
