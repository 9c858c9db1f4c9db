"""The command line, `coopenv COMMAND`: the application in `app`, commands by subject in the other modules."""
