"""One file per pramlintide strategy of the paper; all are functions of the insulin the law has decided on."""
