"""Every figure of the thesis beside the one this program computes, and the thesis's plots drawn anew."""
