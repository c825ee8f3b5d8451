"""The two Gymnasium environments, for one robot and for many, and their spaces."""
