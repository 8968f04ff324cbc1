"""Laws for comparison: LMS, the law as printed (3.11), gradient, and fixed constants."""
