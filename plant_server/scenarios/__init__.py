"""What happens to the person: meals, what is told of them, sugar against a low; `plant_server.scenario` loads them."""
