"""A program in plain Zenoh, without smartcam: what it knows of a fleet stands in docs/bus.md."""

import json
import sys
import uuid

import zenoh


def use(endpoint: str) -> None:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    with zenoh.open(config) as session:
        results = session.declare_subscriber("smartcam/*/topic/results/**")
        replies = session.get("smartcam/*/cameras/**")
        for key, camera in [(str(one.ok.key_expr), one.ok.payload.to_string()) for one in replies]:
            print(key, json.loads(camera)["status_names"])
            request = json.dumps({"timeout": 5, "id": str(uuid.uuid4())})
            service = key.replace("/cameras/", "/service/", 1) + "/trigger"
            answers = [*session.get(service, payload=request, timeout=7)]
            answer = json.loads(answers[0].ok.payload.to_string()) if answers else {"error": "?"}
            print(answer["error"] or answer["result"]["value"])
            if not answer["error"]:  # all subscribers get the result, too
                print(json.loads(results.recv().payload.to_string())["number"])


if __name__ == "__main__":
    use(sys.argv[1])  # such as tcp/plant-server:7447
