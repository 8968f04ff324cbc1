"""Laws to compare with: LMS, the law as printed (3.11), the gradient, and fixed constants."""
