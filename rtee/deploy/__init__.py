"""Installation and removal of a hand as a service on a robot PC."""
