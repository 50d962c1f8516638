"""The landing page, health, and the replies to requests that cannot be served."""


def test_the_landing_page_links_to_what_there_is(client):
    page = client.get("/").json()
    for link in page["links"]:
        assert client.get(link["href"]).status_code == 200, link


def test_a_ready_service_has_a_database_that_answers(client):
    assert client.get("/healthz").json() == {"status": "alive"}
    assert client.get("/readyz").json() == {"status": "ready"}
