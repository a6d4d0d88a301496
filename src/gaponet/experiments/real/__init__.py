"""Real logs that are public: labels that they lack, splits that are frozen, and one table over all of them."""
