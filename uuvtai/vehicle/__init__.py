"""The stack on a vehicle: sensor messages, MAVLink, safety rules, ArduSub, identification."""
